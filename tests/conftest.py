"""People by role and a small plant, for every test that needs the database."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from inspection.models import Region, Rig, Role, Tool, ToolType, User


def _person(name: str, role: Role) -> User:
    return User.objects.create_user(
        username=name, password=f"{name}-knows-the-word", first_name=name.capitalize(), role=role
    )


@pytest.fixture
def vera(db: None) -> User:
    """The viewer."""
    return _person("vera", Role.VIEWER)


@pytest.fixture
def olga(db: None) -> User:
    """The operator."""
    return _person("olga", Role.OPERATOR)


@pytest.fixture
def erik(db: None) -> User:
    """The engineer."""
    return _person("erik", Role.ENGINEER)


@pytest.fixture
def adam(db: None) -> User:
    """The administrator."""
    return _person("adam", Role.ADMIN)


@pytest.fixture
def tool_type(db: None) -> ToolType:
    return ToolType.objects.create(name="Chipping knife", bevel_angle_deg=55.0, edge_length_mm=90.0)


@pytest.fixture
def make_tool(tool_type: ToolType) -> Callable[..., Tool]:
    """Make a tool with regions R1, R2, R3: `make_tool("K-7")`; small frames, so that a scan takes a moment only."""

    def make(code: str = "K-7", *, regions: int = 3, **region: Any) -> Tool:
        tool = Tool.objects.create(code=code, tool_type=tool_type, location="Chipper 1, pocket 3")
        shape = {"length_mm": 0.25, "rows": 64, "flat_row": 4, "flat_rows": 40, **region}
        for n in range(1, regions + 1):
            Region.objects.create(tool=tool, name=f"R{n}", start_mm=10.0 * n, **shape)
        return tool

    return make


@pytest.fixture
def tool(make_tool: Callable[..., Tool]) -> Tool:
    return make_tool()


@pytest.fixture
def rig(db: None) -> Rig:
    return Rig.objects.create(slug="rig1", name="Rig 1", travel_mm=100.0, exposures_us=[100, 300, 900])
