"""Keeps each recipe once, by its content, so that a result can point at exactly the recipe it was made with."""

from __future__ import annotations

from django.db import IntegrityError, transaction

import scanning.recipe
from inspection.models import Recipe

#: What an order uses when nobody says otherwise.
DEFAULT_RECIPE = "HDRE-II"


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
    """Return the row of one of the recipes known by name (NF, SCI, HDRE-I, HDRE-II, HDR-CAM), or raise `BadInput`."""
    return recipe_row(scanning.recipe.Recipe.named(name))


def recipe_of(row: Recipe) -> scanning.recipe.Recipe:
    """Return the working recipe a row holds."""
    return scanning.recipe.Recipe.from_json(row.definition)
