"""Coefficients of the Rosenbrock methods, and what follows from them for x' = v."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._checks import check_positive_number, numbers_of, shown
from .._final import final


@final
class RosenbrockTableau:
    """Coefficients of a stiffly accurate Rosenbrock method in the transformed form.

    (I/(h gamma) - J) U_j = f(t + c_j h, y + sum_m a_jm U_m) + sum_m C_jm U_m / h + h d_j df/dt,
    y_1 = y + sum_m a_sm U_m + U_s,  error estimate U_s (Hairer and Wanner 1996, section IV.7).
    Dense output (theta in [0, 1]): y = (1-theta) y_0 + theta (y_1 + (1-theta) (k_1 + theta (k_2 +
    theta k_3))), k_i = sum_j H_ij U_j.

    From these follow the weights of the eliminated displacements:
    the displacement part of U_j is h (alpha_j v + sum_m beta_jm b_m).

    **Arguments:** of a method of s stages,

    - `gamma`: the number on the diagonal.
    - `a`: rows 2 ... s of a_jm, of 1 ... s - 1 numbers.  Rows that are left out, the last ones,
      are the row before with U_{j-1} added.
    - `c_transformed`: rows 2 ... s of C_jm.
    - `c`, `d`: c_j and d_j, s numbers each.
    - `dense`: rows of H_ij, one to three of s numbers.

    **Raises:** `ValueError` for anything else.

    !!! example

        >>> from jaxchain.solvers import RosenbrockTableau  # Rodas3, of order 3
        >>> rodas3 = RosenbrockTableau(
        ...     gamma=0.5, a=[[0.0], [2.0, 0.0], [2.0, 0.0, 1.0]],
        ...     c_transformed=[[4.0], [1.0, -1.0], [1.0, -1.0, -8.0 / 3.0]],
        ...     c=[0.0, 0.0, 1.0, 1.0], d=[0.5, 1.5, 0.0, 0.0], dense=[[3.0, -1.0, 0.0, 0.0]],
        ... )
        >>> rodas3.a[3].tolist()  # an `AbstractStructuredRosenbrock` has it as its `tableau`
        [2.0, 0.0, 1.0, 0.0]
    """

    def __init__(
        self,
        gamma: float,
        a: list[list[float]],
        c_transformed: list[list[float]],
        c: list[float],
        d: list[float],
        dense: list[list[float]],
    ):
        check_positive_number("gamma", gamma)
        s = np.size(c)
        _check_rows("c", [c], [s], 1)
        _check_rows("d", [d], [s], 1)
        _check_rows("a", a, range(1, s), 0)
        _check_rows("c_transformed", c_transformed, range(1, s), s - 1)
        _check_rows("dense", dense, [s, s, s], 1)
        self.gamma = gamma
        self.a = np.zeros((s, s))
        self.C = np.zeros((s, s))
        for j in range(1, s):
            self.a[j, :j] = a[j - 1] if j <= len(a) else [*self.a[j - 1, : j - 1], 1.0]
            self.C[j, :j] = c_transformed[j - 1]
        self.c = np.array(c)
        self.d = np.array(d)
        self.H = np.array(dense)
        self.alpha = np.zeros(s)
        self.beta = np.zeros((s, s))
        for j in range(s):
            self.alpha[j] = gamma * (1.0 + self.C[j] @ self.alpha)
            self.beta[j] = gamma * (self.a[j] + np.eye(s)[j] + self.C[j] @ self.beta)
        # Stage displacement alone.
        self.place_v = self.a @ self.alpha
        self.place_b = self.a @ self.beta
        # Stage displacement plus h gamma (first right-hand side): what the stiffness acts upon.
        self.stage_v = self.a @ self.alpha + self.alpha
        self.stage_b = self.a @ self.beta + self.beta - gamma * np.eye(s)
        # How much the products C b may magnify what the sweeps leave out.
        self.lag = 100.0 * (1.0 + np.max(np.sum(np.abs(self.stage_b), axis=1)) / gamma)
        # End of the step, and the dense output, in the same weights.
        self.end_v = self.stage_v[-1]
        self.end_b = self.a[-1] @ self.beta + self.beta[-1]
        self.dense_v = self.H @ self.alpha
        self.dense_b = self.H @ self.beta


def _check_rows(name: str, rows: Any, lengths: Sequence[int], least: int) -> None:
    """Raises `ValueError` unless there are `least` rows, or more, of so many finite numbers."""
    count = len(rows) if isinstance(rows, list | tuple | np.ndarray) else -1
    good = least <= count <= len(lengths)
    if good:
        found = [numbers_of(name, row) for row in rows]
        good = all(
            row is not None and row.shape == (length,) and np.isfinite(row).all()
            for row, length in zip(found, lengths, strict=False)
        )
    if not good:
        told = ", ".join(map(str, lengths))
        raise ValueError(
            f"Argument `{name}` must have rows of {told} finite numbers, {least} rows at least, "
            f"but is {shown(rows)}."
        )


RODAS4 = RosenbrockTableau(
    gamma=0.25,
    a=[
        [1.544],
        [0.9466785280815826, 0.2557011698983284],
        [3.314825187068521, 2.896124015972201, 0.9986419139977817],
        [1.221224509226641, 6.019134481288629, 12.53708332932087, -0.687886036105895],
    ],
    c_transformed=[
        [-5.6688],
        [-2.430093356833875, -0.2063599157091915],
        [-0.1073529058151375, -9.594562251023355, -20.47028614809616],
        [7.496443313967647, -10.24680431464352, -33.99990352819905, 11.7089089320616],
        [
            8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136,
            -6.058818238834054,
        ],
    ],
    c=[0.0, 0.386, 0.21, 0.63, 1.0, 1.0],
    d=[0.25, -0.1043, 0.1035, -0.0362, 0.0, 0.0],
    dense=[
        [
            10.12623508344586, -7.487995877610167, -34.80091861555747, -7.992771707568823,
            1.025137723295662, 0.0,
        ],
        [
            -0.6762803392801253, 6.087714651680015, 16.43084320892478, 24.76722511418386,
            -6.594389125716872, 0.0,
        ],
    ],
)  # fmt: skip

RODAS5P = RosenbrockTableau(
    gamma=0.21193756319429014,
    a=[
        [3.0],
        [2.849394379747939, 0.45842242204463923],
        [-6.954028509809101, 2.489845061869568, -10.358996098473584],
        [2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641],
        [
            -7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256,
            0.030198172008377946,
        ],
    ],
    c_transformed=[
        [-14.155112264123755],
        [-17.97296035885952, -2.859693295451294],
        [147.12150275711716, -1.41221402718213, 71.68940251302358],
        [165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306],
        [
            24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125,
            -0.6610691825249471,
        ],
        [
            30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783,
            -19.097331116725623, -28.087943162872662,
        ],
        [
            37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047,
            -40.06618937091002, -54.66780262877968, -9.48861652309627,
        ],
    ],
    c=[
        0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1.0,
        1.0, 1.0,
    ],
    d=[
        0.21193756319429014, -0.42387512638858027, -0.3384627126235924, 1.8046452872882734,
        2.325825639765069, 0.0, 0.0, 0.0,
    ],
    dense=[
        [
            25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204,
            0.524948541321073, 1.1241088310450404, 0.4272876194431874, -0.17202221070155493,
        ],
        [
            -9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796,
            20.176138334709044, 15.98066361424651, -6.789040303419874, -6.710236069923372,
        ],
        [
            11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643,
            -52.072871366152654, -59.78993625266729, -0.15582684282751913, 4.883087185713722,
        ],
    ],
)  # fmt: skip
