"""A chain in motion on its belt: animations, GIFs and strips of stills."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.animation import AbstractMovieWriter, FuncAnimation
from matplotlib.figure import Figure
from PIL import Image

from .._checks import check_kind, check_positive_number, check_whole
from ..model.chain import Chain
from .chain_artist import Curves, Scene, explain
from .films import checked_film, picked_masses
from .style import PAGE_WIDTH, STYLE

HEIGHT = 2.9  # inches
MOST_SHOWN = 8  # masses of a long chain
_COLOURS, _SAMPLES = 64, 8  # of a GIF's palette, and the frames that it is chosen for


def animate(
    chain: Any,
    times: Any,
    states: Any,
    *,
    masses: Any = None,
    frames_per_second: Any = 20,
) -> FuncAnimation:
    """The chain on its moving belt, with the displacements and the phase plane below.

    Masses are displaced by x_n and hatched in orange while they stick; the belt moves at v_d in
    the same unit, and carries on without a jump when the film starts again.

    **Arguments:**

    - `chain`, of which `times` and `states` are a run, see `sticking`.
    - `times`: shape (frames,), dimensionless, increasing; each is one frame.
    - `states`: (x, v), each of shape (frames, n), or a `Simulation` that observed
      `Trajectory(times)`; for films that close see `loop`.
    - `masses`: indices of those that are shown; by default up to eight around the liveliest.

    **Returns:** an animation of matplotlib; `save_gif` writes it, and so does its own `save`.

    **Raises:** `ValueError` for wrong shapes, numbers that are not finite, and too few frames.

    !!! example

        >>> import jax, tempfile, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.plotting import animate, save_gif
        >>> times = np.linspace(0.0, 5.0, 4)[:, None]
        >>> states = np.cos(times), -np.sin(times)  # any film of one mass
        >>> film = animate(paper_chain(n=1), times[:, 0], states)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print(save_gif(film, f"{folder}/film.gif", dpi=40).stat().st_size < 30_000)
        True
    """
    times, states = checked_film(chain, times, states)
    check_positive_number("frames_per_second", frames_per_second, "20 is usual.")
    shown = _shown(chain, states[0], masses)
    with matplotlib.rc_context(STYLE):
        page = Figure(figsize=(PAGE_WIDTH, HEIGHT), layout="constrained")
        page.get_layout_engine().set(h_pad=0.02)  # pyright: ignore
        parts: Any = page.subplot_mosaic("AAA;BBC", height_ratios=(0.9, 1.0))
        scene = Scene(parts["A"], chain, times, states, shown)
        curves = Curves(parts["B"], parts["C"], chain, times, states, scene.sticks, shown)
        explain(parts["A"])
        page.draw_without_rendering()  # settles the layout once
        page.set_layout_engine("none")

    def update(frame: int) -> list[Any]:
        return [*scene.show(frame), *curves.show(frame)]

    return FuncAnimation(
        page, update, frames=len(times), interval=1000.0 / frames_per_second, blit=False
    )


def save_gif(animation: FuncAnimation, path: Any, dpi: Any = 100) -> Path:
    """Writes an animation as a GIF that repeats for ever, in few colours to keep it small.

    **Arguments:** `animation`, what `animate` returned; `path` of the file; `dpi`, dots per inch.

    **Returns:** the path of the file.

    **Raises:** `ValueError` for a `dpi` that is not positive.

    !!! example

        >>> import jax, tempfile, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.plotting import animate, save_gif
        >>> times = np.linspace(0.0, 5.0, 4)[:, None]
        >>> film = animate(paper_chain(n=1), times[:, 0], (np.cos(times), -np.sin(times)))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print(save_gif(film, f"{folder}/film.gif", dpi=40).read_bytes()[:6])
        b'GIF89a'
    """
    remedy = "`animate(...)` makes one."
    check_kind("animation", animation, FuncAnimation, "a `FuncAnimation`", remedy)
    check_kind("path", path, str | Path, "the name of a file")
    path = Path(path)
    if path.suffix.lower() != ".gif":
        raise ValueError(f"Argument `path` must end with .gif, but is {str(path)!r}.")
    check_positive_number("dpi", dpi, "100 is usual.")
    rate = 1000.0 / animation._interval  # pyright: ignore  # no public accessor
    with matplotlib.rc_context(STYLE):
        animation.save(path, writer=_GifWriter(fps=rate), dpi=dpi)
    return path


def film_strip(
    chain: Any, times: Any, states: Any, *, stills: Any = 8, masses: Any = None
) -> Figure:
    """Stills of `animate` below each other, from the first time on at equal distances.

    **Arguments:** as for `animate`; `stills`, how many, at most one for every frame.

    **Returns:** a matplotlib figure, one panel for each still.

    **Raises:** `ValueError` as `animate`, and for more stills than frames.

    !!! example

        >>> import jax, numpy as np
        >>> jax.config.update("jax_enable_x64", True)
        >>> from jaxchain import paper_chain
        >>> from jaxchain.plotting import film_strip
        >>> times = np.linspace(0.0, 5.0, 6)[:, None]
        >>> states = np.cos(times), -np.sin(times)  # any film of one mass
        >>> page = film_strip(paper_chain(n=1), times[:, 0], states, stills=3)
        >>> [axes.get_title(loc="right")[-4:] for axes in page.axes]  # the time of each
        ['0.00', '2.00', '4.00']
    """
    times, states = checked_film(chain, times, states)
    check_whole("stills", stills)
    shown = _shown(chain, states[0], masses)
    if stills > len(times):
        raise ValueError(
            f"Argument `stills` must be at most the number of frames, {len(times)}, but is "
            f"{stills}."
        )
    picked = np.arange(stills) * len(times) // stills
    with matplotlib.rc_context(STYLE):
        page = Figure(figsize=(PAGE_WIDTH, 0.65 * stills), layout="constrained")
        panels = page.subplots(stills, 1, squeeze=False).ravel()
        for frame, axes in zip(picked, panels, strict=True):
            Scene(axes, chain, times, states, shown).show(int(frame))
            axes.set_title(rf"$\tau$ = {times[frame]:.2f}", loc="right", pad=1.5)
        explain(panels[0])
    return page


class _GifWriter(AbstractMovieWriter):
    """Frames with one small palette: less than half as large as by matplotlib's own writer."""

    def setup(self, fig: Figure, outfile: Any, dpi: Any = None) -> None:
        super().setup(fig, outfile, dpi)  # pyright: ignore[reportAbstractUsage]  # has a body
        self.pictures: list[Image.Image] = []

    def grab_frame(self, **savefig_kwargs: Any) -> None:
        buffer = io.BytesIO()
        self.fig.savefig(buffer, format="png", dpi=self.dpi, **savefig_kwargs)
        self.pictures.append(Image.open(buffer).convert("RGB"))

    def finish(self) -> None:
        no_dither = Image.Dither.NONE
        some = self.pictures[:: -(-len(self.pictures) // _SAMPLES)]
        sample = np.concatenate([np.asarray(picture) for picture in some])
        # Coverage, because the colours of few pixels count as well.
        palette = Image.fromarray(sample).quantize(_COLOURS, Image.Quantize.MAXCOVERAGE)
        first, *others = (p.quantize(palette=palette, dither=no_dither) for p in self.pictures)
        first.save(
            self.outfile, save_all=True, append_images=others, loop=0, optimize=True,
            duration=round(1000.0 / self.fps),
        )  # fmt: skip


def _shown(chain: Chain, x: np.ndarray, masses: Any) -> list[int]:
    """The masses to draw, neighbours side by side; round the ring, if need be."""
    n = chain.n
    if masses is not None:
        return picked_masses(n, masses)
    if n <= MOST_SHOWN:
        return list(range(n))
    weight = np.ptp(x, axis=0) ** 2
    middle = np.angle(np.sum(weight * np.exp(2j * np.pi * np.arange(n) / n))) * n / (2 * np.pi)
    start = round(float(middle) - (MOST_SHOWN - 1) / 2)
    if chain.ends == "free":
        start = min(max(start % n, 0), n - MOST_SHOWN)
    return [(start + i) % n for i in range(MOST_SHOWN)]
