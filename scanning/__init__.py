"""Measures: frames of a laser line in, heights and damage in micrometres out. Needs no Django, no worker, no network.

The public names load when they are first asked for, so that `import scanning` stays instant.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "Recipe": "scanning.recipe",
    "Stack": "scanning.frames",
    "StackHeader": "scanning.frames",
    "RangeImage": "scanning.range_image",
    "Profile": "scanning.pipeline.stream",
    "ProfileStream": "scanning.pipeline.stream",
    "extract_profile": "scanning.pipeline.whole",
    "process_stack": "scanning.pipeline.whole",
    "open_stack": "scanning.stacks",
    "inspect_surface": "scanning.surface",
    "BadInput": "scanning.errors",
}
__all__ = [
    "BadInput",
    "Profile",
    "ProfileStream",
    "RangeImage",
    "Recipe",
    "Stack",
    "StackHeader",
    "__version__",
    "extract_profile",
    "inspect_surface",
    "open_stack",
    "process_stack",
]

if TYPE_CHECKING:
    from scanning.errors import BadInput
    from scanning.frames import Stack, StackHeader
    from scanning.pipeline.stream import Profile, ProfileStream
    from scanning.pipeline.whole import extract_profile, process_stack
    from scanning.range_image import RangeImage
    from scanning.recipe import Recipe
    from scanning.stacks import open_stack
    from scanning.surface import inspect_surface


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'scanning' has no attribute {name!r}")
    value = getattr(import_module(home), name)
    globals()[name] = value
    return value
