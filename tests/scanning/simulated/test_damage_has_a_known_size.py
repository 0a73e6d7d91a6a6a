"""Truth of damages: closed forms, an independent sum over a fine grid, and what a chip does to the edge."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from scanning.errors import BadInput
from scanning.rig.simulated.scenes import scene
from scanning.rig.simulated.surface import Bevel, Damage, measure_damage


def test_a_dent_has_the_volume_of_an_elliptic_paraboloid() -> None:
    dent = Damage("dent", s_um=0.0, length_um=340.0, reach_um=150.0, depth_um=72.0, y_um=420.0)
    exact_mm3 = math.pi / 2 * 72.0 * 170.0 * 150.0 * 1e-9
    true = measure_damage(dent)
    assert true.volume_mm3 == pytest.approx(exact_mm3, rel=1e-5)
    assert true.volume_removed_mm3 == pytest.approx(exact_mm3, rel=1e-5)
    assert true.depth_um == pytest.approx(72.0)


@pytest.mark.parametrize("worn_um", [0.0, 40.0, 120.0])
def test_a_chip_has_the_volume_that_a_fine_grid_counts(worn_um: float) -> None:
    chip = Damage("chip", s_um=500.0, length_um=420.0, reach_um=230.0, depth_um=112.0)
    s = (np.arange(1000) + 0.5)[:, None]
    y = (np.arange(0, 2500) + 0.5)[None, :] / 10
    depth = chip.depth_at(s, y)
    thickness = y * math.tan(math.radians(55.0))
    seen = np.where((depth <= thickness) & (y >= worn_um), depth, 0.0)
    true = measure_damage(chip, worn_um)
    assert true.volume_mm3 == pytest.approx(float(seen.sum()) * 0.1 * 1e-9, rel=2e-3)
    assert true.depth_um == pytest.approx(float(seen.max()), abs=0.2)
    if worn_um == 0.0:
        removed = np.minimum(depth, thickness).sum() * 0.1 * 1e-9
        assert true.volume_removed_mm3 == pytest.approx(float(removed), rel=2e-3)


def test_a_chip_takes_the_edge_with_it() -> None:
    chip = Damage("chip", s_um=500.0, length_um=420.0, reach_um=230.0, depth_um=112.0)
    bevel = Bevel(1, (chip,))
    y = np.linspace(0.5, 300.0, 600)
    inside = np.isfinite(bevel.height_um(np.full_like(y, 500.0), y))
    outside = np.isfinite(bevel.height_um(np.full_like(y, 900.0), y))
    assert outside.all()
    assert float(y[inside].min()) == pytest.approx(measure_damage(chip).recession_um, abs=1.0)


def test_the_sum_of_deviations_is_the_sum_of_the_volumes() -> None:
    knife = scene("R2", seed=2, texture_um=0.0)
    truth = knife.truth(rows=200, steps=1000, step_um=2.0)
    missing = -np.nansum(truth.deviation_um) * truth.row_pitch_um * 2.0 * 1e-9
    assert missing == pytest.approx(sum(d["volume_mm3"] for d in truth.damages), rel=0.02)


@pytest.mark.parametrize(("name", "severities"), [("R1", []), ("R2", ["medium", "medium", "minor"]), ("R3", ["large"])])
def test_the_regions_carry_the_papers_damages(name: str, severities: list[str]) -> None:
    damages = scene(name).damage_truths()
    assert sorted(d["severity"] for d in damages) == severities
    for damage in damages:
        half = damage["length_mm"] / 2
        assert damage["position_mm"] - half > 0.0
        assert damage["position_mm"] + half < 240 * 8.33e-3


def test_wear_moves_the_edge_back_by_its_mean_and_never_forward() -> None:
    edges = []
    for wear in (0.0, 50.0, 150.0, 400.0):
        truth = scene("R1", seed=3, wear_um=wear).truth(rows=200, steps=1205)
        edges.append((~truth.visible).sum(axis=0) * truth.row_pitch_um)
    for wear, edge in zip((50.0, 150.0, 400.0), edges[1:], strict=True):
        # A row is gone as soon as its middle is, which counts half a row too many on average.
        back = edge - edges[0] - truth.row_pitch_um / 2
        assert back.mean() == pytest.approx(wear, rel=0.06)
        assert back.min() > 0.25 * wear


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (("chip", 0, 100, 50, 60), "steeper than the camera can see"),
        (("dent", 0, 400, 200, 60, 100), "reaches over the edge"),
        (("chip", 0, 400, 200, 60, 10), "lies on the edge"),
        (("dent", 0, 400, -1, 60, 300), "positive"),
    ],
)
def test_damage_that_cannot_be_is_refused_in_one_sentence(wrong: tuple[Any, ...], sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence):
        Damage(*wrong)
