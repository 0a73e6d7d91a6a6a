"""The little drawing both pictures of the report are made of: shapes and text as SVG, in millimetres of paper."""

from __future__ import annotations

from html import escape
from math import floor, log10

INK = "#1d2730"
FAINT = "#9aa5ad"
FONT = "Libertinus Serif"


class Drawing:
    """An SVG of ``width`` x ``height`` mm that is written to from the back to the front."""

    def __init__(self, width: float, height: float) -> None:
        self.width, self.height = width, height
        self.parts: list[str] = []

    def line(
        self, x1: float, y1: float, x2: float, y2: float, colour: str = INK, width: float = 0.2, dash: str = ""
    ) -> None:
        style = f' stroke-dasharray="{dash}"' if dash else ""
        self.parts.append(
            f'<line x1="{x1:.3f}" y1="{y1:.3f}" x2="{x2:.3f}" y2="{y2:.3f}" stroke="{colour}" '
            f'stroke-width="{width}"{style}/>'
        )

    def path(self, points: list[tuple[float, float]], colour: str, width: float = 0.35, fill: str = "none") -> None:
        if not points:
            return
        d = "M" + " L".join(f"{x:.3f} {y:.3f}" for x, y in points) + ("Z" if fill != "none" else "")
        stroke = f'stroke="{colour}" stroke-width="{width}" stroke-linejoin="round"' if width else 'stroke="none"'
        opacity = ' fill-opacity="0.13"' if fill != "none" else ""
        self.parts.append(f'<path d="{d}" fill="{fill}"{opacity} {stroke}/>')

    def box(
        self, x: float, y: float, w: float, h: float, colour: str = INK, width: float = 0.2, fill: str = "none"
    ) -> None:
        self.parts.append(
            f'<rect x="{x:.3f}" y="{y:.3f}" width="{w:.3f}" height="{h:.3f}" fill="{fill}" stroke="{colour}" '
            f'stroke-width="{width}"/>'
        )

    def mark(self, x: float, y: float, shape: str, colour: str, filled: bool = True) -> None:
        """A data point: circle, square or triangle, hollow where it was not used."""
        fill, r = (colour if filled else "#ffffff"), 0.75
        look = f'fill="{fill}" stroke="{colour}" stroke-width="0.25"'
        if shape == "circle":
            self.parts.append(f'<circle cx="{x:.3f}" cy="{y:.3f}" r="{r}" {look}/>')
        elif shape == "square":
            self.parts.append(f'<rect x="{x - r:.3f}" y="{y - r:.3f}" width="{2 * r}" height="{2 * r}" {look}/>')
        else:
            corners = f"M{x - r:.3f} {y + r:.3f}L{x + r:.3f} {y + r:.3f}L{x:.3f} {y - r:.3f}Z"
            self.parts.append(f'<path d="{corners}" {look}/>')

    def text(
        self,
        x: float,
        y: float,
        words: str,
        size: float = 2.4,
        anchor: str = "start",
        colour: str = INK,
        turn: float = 0,
        halo: bool = False,
        bold: bool = False,
    ) -> None:
        turned = f' transform="rotate({turn} {x:.3f} {y:.3f})"' if turn else ""
        weight = ' font-weight="bold"' if bold else ""
        base = f'x="{x:.3f}" y="{y:.3f}" font-family="{FONT}" font-size="{size}" text-anchor="{anchor}"{turned}{weight}'
        if halo:
            white = 'fill="#ffffff" stroke="#ffffff" stroke-width="0.7" stroke-linejoin="round"'
            self.parts.append(f"<text {base} {white}>{escape(words)}</text>")
        self.parts.append(f'<text {base} fill="{colour}">{escape(words)}</text>')

    def picture(self, x: float, y: float, w: float, h: float, png_base64: str) -> None:
        self.parts.append(
            f'<image x="{x:.3f}" y="{y:.3f}" width="{w:.3f}" height="{h:.3f}" preserveAspectRatio="none" '
            f'image-rendering="optimizeSpeed" href="data:image/png;base64,{png_base64}"/>'
        )

    def svg(self) -> str:
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{self.width:.3f}mm" height="{self.height:.3f}mm" '
            f'viewBox="0 0 {self.width:.3f} {self.height:.3f}">{"".join(self.parts)}</svg>'
        )


def ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers from ``low`` to ``high``, roughly ``about`` of them."""
    span = high - low
    if span <= 0:
        return [low]
    raw = span / max(1, about)
    scale = 10.0 ** floor(log10(raw))
    step = next(scale * m for m in (1, 2, 2.5, 5, 10) if scale * m >= raw * 0.999)
    first = int(-(-(low - 1e-9 * span) // step))
    found = []
    while first * step <= high + 1e-9 * span:
        found.append(first * step)
        first += 1
    return found


def tick_text(value: float) -> str:
    text = f"{value:.4f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text.replace("-", "−")
