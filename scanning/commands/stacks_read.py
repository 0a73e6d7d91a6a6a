"""A stack from the command line as a range image: what calibrate, check and noise have in common."""

from __future__ import annotations

from pathlib import Path

from scanning.commands.progress import shown
from scanning.errors import BadInput
from scanning.range_image import RangeImage
from scanning.recipe import Centroid, Exposure, Line, Recipe

GAUGE_RECIPE = "GAUGE"
"""One image per height, all exposures fused: treads of any brightness, walls not smeared along the scan. Averaging over
a whole tread does the rest."""


def range_image_of(path: Path, recipe_name: str) -> RangeImage:
    """Process the stack at ``path`` with a recipe by name, or with `GAUGE_RECIPE`."""
    from scanning.pipeline import warm_up
    from scanning.pipeline.whole import process_stack
    from scanning.stacks import open_stack

    with open_stack(path) as stack:
        if recipe_name == GAUGE_RECIPE:
            logarithmic = stack.header.response == "logarithmic"
            fusing = () if logarithmic else (Exposure(fewest=1),)
            recipe = Recipe(GAUGE_RECIPE, (*fusing, Line(), Centroid()))
        else:
            recipe = Recipe.named(recipe_name)
        recipe.check_fits(stack.header)
        warm_up(shown("preparing"))
        return process_stack(stack, recipe, None, shown(path.name))


def heights_mm(text: str) -> list[float]:
    """Parse "0,0.14,0.25": heights in mm, comma or semicolon between."""
    try:
        heights = [float(one) for one in text.replace(";", ",").split(",")]
    except ValueError:
        raise BadInput(f'--heights "{text}" is not a list of heights in mm; write for example 0,0.14,0.25') from None
    wrong = next((one for one in heights if not abs(one) < 1e3), None)
    if wrong is not None:
        raise BadInput(f"--heights: {wrong} is not a height in mm; write for example 0,0.14,0.25")
    return heights
