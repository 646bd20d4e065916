"""A hardware rig on a belt: where vibration sets in, and up to which speed it survives.

Veraszto, Stepan, Nonlinear dynamics of hardware-in-the-loop experiments on stick-slip phenomena,
Int. J. Non-Linear Mechanics 94 (2017), F = (C + (C0 - C) exp(-c_v |w|)) sgn w + b_s w, with the
Hopf speed and the fold to third order; the exact fold is new.  Draws all cycles into rig.png.
"""

import matplotlib.pyplot as plt
import numpy as np
from _report import report

from jaxchain import Chain, ExponentialDecay, continue_cycle, find_fold, hopf_belt_speed
from jaxchain.plotting import save_figure

m, b0, k, C, C0, c_v, b_s = 0.538, 5.746, 6957.0, 2.0, 6.0, 10.0, 0.2  # kg, N, m, s
omega = np.sqrt(k / m)
speed = C0 / k * omega  # m/s, the unit of speed; that of length is C0 / k
law = ExponentialDecay(1.0, C / C0, v_ref=1 / (c_v * speed))
rig = Chain(1, law, belt_speed=0.3 / speed, damping_ratio=(b0 + b_s) / (2 * m * omega))

dry = find_fold(rig)
hopf, fold = float(hopf_belt_speed(rig)) * speed, float(dry.belt_speed) * speed
cubic = 4 / c_v * (1 - np.sqrt(1 - c_v * 0.190616073 / 2))
page, axes = plt.subplots(figsize=(3.4, 3.0), layout="constrained")
smooth = rig.with_(width=1e-3)
top = find_fold(smooth)
for side, line, label in ("slip", "--", "slip, unstable"), ("stick", "-", "stick and slip"):
    branch = continue_cycle(
        smooth.with_(belt_speed=top.belt_speed), top.state, top.period,
        direction=side, max_step=0.1, bounds=(0.1, np.inf), keep_part=False,
    )  # fmt: skip
    axes.plot(branch.parameter * speed, branch.amplitude[:, 0] * C0 / k * 1e3, line, label=label)
axes.axvspan(hopf, fold, alpha=0.1, label="bistable")
axes.axvline(cubic, color="black", linestyle=":", label="fold to third order")
axes.set(xlabel="belt speed (m/s)", ylabel="amplitude (mm)", xlim=(0.05, 0.35), ylim=(0, None))
page.legend(loc="outside lower center", ncols=2, fontsize=7)
save_figure(page, "rig")
report(
    __doc__,
    ("Hopf speed, m/s", 0.190616073, hopf, 1e-9),
    ("fold to third order, from it, m/s", 0.313356, cubic, 1e-6),
    ("exact fold of the dry system, m/s", None, fold, None),
    ("period there, ms", None, 1e3 * dry.period / omega, None),
)
