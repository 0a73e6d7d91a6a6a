"""The registry: knife regions, gauge and plate, their stray light, and how a part is laid on the rig again."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import numpy as np
import pytest

import scanning.rig.simulated
from scanning.errors import BadInput
from scanning.rig.simulated.render import Renderer
from scanning.rig.simulated.scenes import GAUGE_HEIGHTS_UM, REFLECTIONS, SCENES, scene
from tests.scanning.simulated.looking import scan


def test_the_flat_sub_region_of_r1_is_ground_flat() -> None:
    truth = scene("R1", seed=4).truth(rows=1000, steps=241)
    sq = float(truth.deviation_um[380:980].std())
    assert 0.2 < sq < 0.6


def test_rows_beyond_the_edge_are_dark_and_the_bevel_is_not() -> None:
    knife = scene("R1", seed=4, stray="none", decades=0.0)
    light = scan(Renderer(knife, rows=200, columns=128), 6, 50.0).mean(axis=0).max(axis=1)
    assert light[:14].max() < 0.02 * np.median(light[40:])
    assert light[24:].min() > 0.2 * np.median(light[40:])


def test_reflectivity_spans_decades_along_and_across() -> None:
    reflectivity = scene("R1", seed=4).truth(rows=1000, steps=1205).reflectivity
    low, high = np.quantile(reflectivity, [0.005, 0.995])
    assert np.log10(high / low) > 1.5
    assert np.log10(reflectivity).std(axis=0).mean() > 0.2
    assert np.log10(reflectivity).std(axis=1).mean() > 0.2


def test_the_gauge_carries_table_2() -> None:
    truth = scene("gauge").truth(rows=1000, steps=2)
    assert np.unique(truth.height_um).tolist() == pytest.approx([0.0, *GAUGE_HEIGHTS_UM])


def test_stray_light_can_outshine_the_line_and_moves_in_its_own_way() -> None:
    clean, stray = scene("R1", seed=4, stray="none"), scene("R1", seed=4, stray="busy")
    at = [Renderer(stray).irradiance(p) - Renderer(clean).irradiance(p) for p in (0.0, 2000.0)]
    assert all(frame.min() > -1e-3 for frame in at)
    assert at[0].max() > 2 * stray.level_e_per_us
    columns = np.arange(256)
    moved = [float((f[600:760, 60:100].sum(0) * columns[60:100]).sum() / f[600:760, 60:100].sum()) for f in at]
    assert moved[1] - moved[0] == pytest.approx(-6.0, abs=1.0)
    line = [float((f[280:330, 150:220].sum(0) * columns[150:220]).sum() / f[280:330, 150:220].sum()) for f in at]
    assert line[1] - line[0] == pytest.approx(4.0, abs=1.0)


def test_the_knife_has_some_stray_light_unless_told_otherwise() -> None:
    usual, clean = (
        Renderer(scene("R1", seed=4)).irradiance(0.0),
        Renderer(scene("R1", seed=4, stray="none")).irradiance(0.0),
    )
    brighter = np.abs(usual - clean) > 1.0
    assert 0.001 < brighter.mean() < 0.01
    assert not brighter[700:820].any()


@pytest.mark.parametrize("name", list(REFLECTIONS))
def test_every_set_of_reflections_fits_small_and_large_frames(name: str) -> None:
    for rows, columns in ((40, 32), (1000, 256)):
        frame = Renderer(scene("R1", stray=name), rows=rows, columns=columns).irradiance(300.0)  # type: ignore[arg-type]
        assert np.isfinite(frame).all()
        assert frame.min() >= 0.0


def test_each_visit_lies_differently_but_is_the_same_knife() -> None:
    first, second, again = (scene("R2", seed=5, visit=v) for v in (1, 2, 2))
    assert first.pose != second.pose
    assert second.pose == again.pose
    assert first.seed == second.seed
    assert abs(second.pose.shift_along_um) < 100.0
    at = [s.damage_truths()[0]["position_mm"] - s.pose.shift_along_um * 1e-3 for s in (first, second)]
    assert at[0] == pytest.approx(at[1])


def test_the_second_system_makes_logarithmic_images_of_its_own_size() -> None:
    renderer = Renderer(scene("R1", system="IS2"))
    image = renderer.expose(renderer.irradiance(0.0), 0.0, np.random.default_rng(0))
    assert image.shape == (576, 256)
    assert abs(float(np.median(image)) - renderer.sensor.dark_level) < 2.0
    assert image.max() > 100


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: scene("R9"), "There is no scene 'R9'; choose one of R1, R2, R3, gauge, flat"),
        (lambda: scene("R1", system="IS7"), "no imaging system 'IS7'"),
        (lambda: scene("R1", stray="lots"), "no stray reflections 'lots'"),
        (lambda: scene("gauge", wear_um=5.0), "no edge"),
        (lambda: scene("R1", wear_um=-5.0), "between 0 and 2000"),
        (lambda: scene("R1", visit=-1), "from 0 upwards"),
        (lambda: Renderer(scene("R1"), rows=5000), "does not fit the camera"),
        (lambda: Renderer(scene("R1"), rows=50).irradiance(float("nan")), "position"),
    ],
)
def test_what_cannot_lie_on_the_rig_is_refused_in_one_sentence(call, sentence: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BadInput, match=sentence):
        call()


def test_every_scene_describes_itself_in_json() -> None:
    for name in SCENES:
        told = json.loads(json.dumps(scene(name).parameters()))
        assert told["scene"] == name


def test_the_simulator_knows_nothing_of_the_pipeline_that_is_judged_by_it() -> None:
    forbidden = ("scanning.pipeline", "scanning.recipe", "scanning.surface", "scanning.calibration", "scanning.optics")
    folder = Path(str(scanning.rig.simulated.__file__)).parent
    seen = 0
    for file in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [str(node.module), *(f"{node.module}.{a.name}" for a in node.names)]
            seen += len(names)
            assert not [n for n in names if n.startswith(forbidden)], f"{file.name} imports {names}"
    assert seen > 20
