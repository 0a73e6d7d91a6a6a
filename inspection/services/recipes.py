"""Keeps each recipe once, by its content, so that a result can point at exactly the recipe it was made with."""

from __future__ import annotations

from django.db import IntegrityError, transaction

import scanning.recipe
from inspection.models import Recipe

#: Images PRECISE and SCI average; a shorter scan can only be read image by image.
WINDOW = 5


def recipe_row(recipe: scanning.recipe.Recipe) -> Recipe:
    """Return the row of ``recipe``, adding it if its content is new."""
    sha256 = recipe.sha256()
    row: Recipe | None = Recipe.objects.filter(sha256=sha256).first()
    if row is not None:
        return row
    try:
        with transaction.atomic():
            return Recipe.objects.create(name=recipe.name, definition=recipe.to_json(), sha256=sha256)
    except IntegrityError:  # another process added it in between
        return Recipe.objects.get(sha256=sha256)


def recipe_named(name: str) -> Recipe:
    """Return the row of one of the recipes known by name (`scanning.recipe.Recipe.NAMES`), or raise `BadInput`."""
    return recipe_row(scanning.recipe.Recipe.named(name))


def usual_recipe(response: str, steps: int) -> scanning.recipe.Recipe:
    """What is used when nobody says otherwise: of the recipes that fit the camera and the scan, the one of least error.

    ``response`` "linear" or "logarithmic"; ``steps`` of the scan. Averages slide, so the step stays the pitch and
    damage of a tenth of a millimetre stays visible.
    """
    if steps < WINDOW:
        return scanning.recipe.Recipe.named("NF")
    name = "HDR-CAM" if response == "logarithmic" else "PRECISE"
    return scanning.recipe.Recipe.named(name).with_settings({"sci.mode": "sliding"})


def recipe_of(row: Recipe) -> scanning.recipe.Recipe:
    """Return the working recipe a row holds."""
    return scanning.recipe.Recipe.from_json(row.definition)
