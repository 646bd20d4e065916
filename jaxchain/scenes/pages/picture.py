"""A figure as text within a page, as sharp as there is room for."""

from __future__ import annotations

import base64
import io
from pathlib import Path

from PIL import Image

# Below this a figure is no longer read.
_LEAST_WIDTH = 300


def as_text(file: Path, room: int) -> tuple[str, bool] | None:
    """The PNG file as a `data:` address of at most `room` characters, and whether it is as sharp
    as the file; None if there is no file, or none that can be read, or too little room."""
    try:
        content = file.read_bytes()
        whole = True
        while len(text := _address(content)) > room:
            whole = False
            with Image.open(io.BytesIO(content)) as image:
                size = [round(0.7 * pixels) for pixels in image.size]
                if size[0] < _LEAST_WIDTH:
                    return None
                smaller = io.BytesIO()
                image.convert("RGB").resize((size[0], size[1])).save(smaller, "PNG", optimize=True)
            content = smaller.getvalue()
    except (OSError, ValueError, Image.DecompressionBombError):
        return None
    return text, whole


def _address(content: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(content).decode()
