"""The parameters of a chain and of the friction laws, each described once.

These tables are used by `Chain.with_` and its checks, sweeps, datasets with their units, the
tables of scene files and the labels of axes.  A new parameter of the chain needs one line here,
and its physics in `model/chain.py`.  This module does not need JAX.
"""

import re
from typing import Literal, NamedTuple

SPEED = "x0 omega_n"
Sign = Literal["any", "nonnegative", "positive"]


class Parameter(NamedTuple):
    """One parameter: its names, its allowed values, and whether it may be given per mass.

    `symbol` is LaTeX without dollars, empty if there is none; `meaning` is the description in
    scene files, and `remedy` the end of an error message.  `per` is "mass" or "spring" if it may
    be given for each; a `required` parameter must be given in a scene, others have a `default`.
    `sign` and `floors`, the names of others that it must not fall below, are its domain.
    Searches stay in this domain, and in `searched` where that is narrower: negative damping is a
    model of its own, but as the result of a fit a mistake.
    `usual` is its value in the paper, eq. (7).

    >>> PARAMETERS["belt_speed"].label
    'belt speed $\\\\tilde v_d$ (–)'
    >>> PARAMETERS["belt_speed"].label_text
    'belt speed v_d, in x0 omega_n'
    """

    name: str
    words: str
    symbol: str = ""
    unit: str = "1"
    sign: Sign = "any"
    floors: tuple[str, ...] = ()
    floor_remedy: str = ""
    searched: Sign | None = None
    per: Literal["mass", "spring"] = "mass"
    required: bool = False
    default: float | None = None
    usual: float | None = None
    meaning: str = ""
    remedy: str = ""

    @property
    def label(self) -> str:
        """The label of an axis."""
        return f"{self.words} ${self.symbol}$ (–)" if self.symbol else f"{self.words} (–)"

    @property
    def long_name(self) -> str:
        """The name in plain letters, for datasets and help."""
        plain = re.sub(r"\\tilde |\\(var)?|[{}]", "", self.symbol)
        return f"{self.words} {plain}".strip()

    @property
    def label_text(self) -> str:
        """The name with the unit."""
        return self.long_name if self.unit == "1" else f"{self.long_name}, in {self.unit}"

    @property
    def description(self) -> str:
        """The description of its key in the tables of a chain and of a friction law."""
        must = " Required unless swept." if self.required else ""
        return f"{self.label_text.capitalize()}. {self.meaning}{must}"


_MU = "a friction coefficient is a force ratio, such as 0.5."
_ROWS = (
    Parameter(
        "belt_speed", "belt speed", r"\tilde v_d", SPEED, required=True, usual=1.5,
        meaning="Negative for a belt that runs the other way; one number, or one per mass.",
        remedy="it is a speed, such as 1.5.",
    ),
    Parameter(
        "damping_ratio", "damping ratio", r"\xi", required=True, usual=0.05,
        meaning="One number, or one per mass.", remedy="it is a ratio, such as 0.05.",
        searched="nonnegative",
    ),
    Parameter(
        "coupling", "coupling", r"\eta_c", sign="nonnegative", per="spring", usual=0.01,
        meaning="Of the springs between neighbours, relative to the nominal spring to ground; one "
        "number, or one per spring; absent: no springs.",
        remedy="it is a spring constant, such as 0.01.",
    ),
    Parameter(
        "stiffness", "relative stiffness", sign="positive", default=1.0, usual=1.0,
        meaning="Of the spring to ground, 1 for the nominal one; one number, or one per mass.",
        remedy="1 is the nominal spring to ground.",
    ),
    Parameter(
        "normal_load", "relative normal load", sign="nonnegative", usual=1.0,
        meaning="1 for the nominal load; one number, or one per mass; absent: 1 everywhere.",
        remedy="a mass cannot pull at the belt.",
    ),
)  # fmt: skip
_FRICTION_ROWS = (
    Parameter(
        "mu_static", "static friction coefficient", r"\mu_{st}", sign="nonnegative",
        required=True, usual=1.0, meaning="Friction at rest.", remedy=_MU,
        floors=("mu_dynamic", "mu_kinetic"),
        floor_remedy="friction at rest exceeds friction in motion; raise `mu_static`.",
    ),
    Parameter(
        "mu_dynamic", "dynamic friction coefficient", r"\mu_d", sign="nonnegative",
        required=True, usual=0.5, meaning="Friction at high speed.", remedy=_MU,
    ),
    Parameter(
        "mu_kinetic", "kinetic friction coefficient", r"\mu_k", sign="nonnegative",
        required=True, usual=0.5, meaning="Friction in motion, at every speed.", remedy=_MU,
    ),
    Parameter(
        "v_ref", "reference speed", r"\tilde v_0", SPEED, sign="positive", required=True,
        usual=0.5, meaning="Speed over which friction decays.",
        remedy="it is the speed over which friction decays, such as 0.5.",
    ),
    Parameter(
        "mu_viscous", "viscous friction coefficient", r"\mu_v", sign="nonnegative",
        required=True, meaning="Growth of friction per `v_ref` of speed.",
        remedy="it is how fast friction grows with speed.",
    ),
    Parameter(
        "width", "regularization width", r"\varepsilon", SPEED, sign="positive", required=True,
        usual=1e-3,
        meaning="Relative speed within which smoothed friction changes direction; ignored for dry "
        "friction.",
        remedy="1e-3 is usual; for dry friction give the law itself, or `width=None`.",
    ),
)  # fmt: skip

# By name, in the order of errors and datasets.
CHAIN = {row.name: row for row in _ROWS}
FRICTION = {row.name: row for row in _FRICTION_ROWS}
PARAMETERS = CHAIN | FRICTION


def parameter(name: str) -> Parameter:
    """The row of a parameter; in a custom friction law the name is the description.

    The row of an entry, "stiffness[3]", is the row of its array without the symbol.

    >>> parameter("mu_peak").label, parameter("mu_peak").sign
    ('mu_peak (–)', 'any')
    """
    array, bracket, index = name.partition("[")
    row = PARAMETERS.get(array, Parameter(name, name, required=True))
    if not bracket or array not in PARAMETERS:
        return row
    return row._replace(name=name, words=f"{row.words} [{index}", symbol="")
