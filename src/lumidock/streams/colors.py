"""The colours of layers and stages, wherever they are drawn: on images of dark water, on plots and on pages."""

from __future__ import annotations

from lumidock.station import Station

# front layer first; further layers repeat them
ON_WATER = ("#ffc24a", "#62b5ff", "#7dff8a", "#e29bff")  # amber, blue, green, violet
ON_PAPER = ("#b46a00", "#2763c4", "#1c8752", "#6a4fc0")
ON_NIGHT = ("#f0a63a", "#76adff", "#4cc38a", "#b39dff")  # of a page in dark mode
SPURIOUS_ON_WATER = "#ff5a5f"
STAGES_ON_PAPER = {"search": "#74818d", "front": ON_PAPER[0], "transition": ON_PAPER[2], "rear": ON_PAPER[1]}
STAGES_ON_NIGHT = {"search": "#93a1ae", "front": ON_NIGHT[0], "transition": ON_NIGHT[2], "rear": ON_NIGHT[1]}


def of_layer(station: Station, light: int, palette: tuple[str, ...] = ON_WATER) -> str:
    """The colour of a light by its layer; of a detection that is no light (-1) the colour of spurious ones."""
    return palette[station.layer_rank(light) % len(palette)] if light >= 0 else SPURIOUS_ON_WATER


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue, 0-255, of `#rrggbb`."""
    red, green, blue = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return red, green, blue


def bgr(color: str) -> tuple[int, int, int]:
    """The same in the order that OpenCV draws in."""
    return rgb(color)[2], rgb(color)[1], rgb(color)[0]
