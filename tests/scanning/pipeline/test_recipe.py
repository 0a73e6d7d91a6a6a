"""A recipe says in full what was done, reads settings given as text, and refuses what makes no sense."""

from __future__ import annotations

import json

import pytest

from scanning.errors import BadInput
from scanning.frames import StackHeader
from scanning.recipe import Centroid, Compound, Exposure, Line, Recipe, Tone


def header(times: tuple[float, ...] = (100.0, 300.0), response: str = "linear") -> StackHeader:
    return StackHeader(10, 64, 5, times, 8.33, 7.15, 0.0142, response=response)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "order"),
    [
        ("NF", ["msnn", "cog"]),
        ("SCI", ["sci", "msnn", "cog"]),
        ("HDRE-I", ["sci", "hdre", "glt", "msnn", "cog"]),
        ("HDRE-II", ["hdre", "glt", "sci", "msnn", "cog"]),
        ("HDR-CAM", ["sci", "msnn", "cog"]),
    ],
)
def test_the_five_methods_are_the_papers_orders(name: str, order: list[str]) -> None:
    recipe = Recipe.named(name)
    assert [o.key for o in recipe.operations] == order
    assert recipe.name == name
    assert name in Recipe.NAMES


@pytest.mark.parametrize("name", Recipe.NAMES)
def test_a_recipe_survives_json(name: str) -> None:
    recipe = Recipe.named(name)
    again = Recipe.from_json(json.loads(json.dumps(recipe.to_json())))
    assert again == recipe
    assert again.sha256() == recipe.sha256()


def test_changed_recipes_survive_json_too() -> None:
    recipe = Recipe.named("HDRE-II").with_settings(
        {"sci.mode": "sliding", "sci.window": "3", "glt.p": "1", "msnn.k": "2.5", "exposures": "300, 100"}
    )
    assert recipe.compound == Compound("sliding", 3)
    assert recipe.tone == Tone(1.0)
    assert recipe.line.k == 2.5
    assert recipe.exposures_us == (100.0, 300.0)
    assert Recipe.from_json(json.dumps(recipe.to_json())) == recipe


def test_whole_numbers_hash_alike_however_they_were_written() -> None:
    one = Recipe.named("NF").with_settings({"msnn.gate_px": "12"})
    assert one.sha256() == Recipe.named("NF").sha256()


def test_another_parameter_is_another_hash() -> None:
    hashes = {Recipe.named(n).sha256() for n in Recipe.NAMES}
    hashes.add(Recipe.named("SCI").with_settings({"sci.window": "4"}).sha256())
    assert len(hashes) == len(Recipe.NAMES) + 1


def test_default_and_none_give_a_parameter_back_to_the_recipe() -> None:
    recipe = Recipe.named("NF").with_settings({"msnn.k": "2"}).with_settings({"msnn.k": "default"})
    assert recipe == Recipe.named("NF")


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"sci.mod": "sliding"}, "has no setting"),
        ({"glt.p": "1"}, "has no setting"),
        ({"sci.mode": "rolling"}, "one of block, sliding"),
        ({"sci.window": "0"}, "whole number"),
        ({"sci.window": "2.5"}, "whole number"),
        ({"msnn.k": "abc"}, "must be a number"),
        ({"msnn.k": "nan"}, "must be a number"),
        ({"msnn.floor": "1"}, "from 0 to 0.99"),
        ({"msnn.seed": "last"}, "one of first, best"),
        ({"msnn.gate_max_px": "3"}, "from 12"),
        ({"exposure": "short"}, "must be a number"),
    ],
)
def test_a_bad_setting_gets_one_sentence(settings: dict[str, str], sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence) as caught:
        Recipe.named("SCI").with_settings(settings)
    assert "\n" not in str(caught.value)


def test_an_unknown_setting_is_answered_with_the_known_ones() -> None:
    with pytest.raises(BadInput, match=r"sci\.mode, sci\.window"):
        Recipe.named("SCI").with_settings({"window": "5"})


def test_an_unknown_recipe_is_answered_with_the_known_ones() -> None:
    with pytest.raises(BadInput, match="NF, SCI, HDRE-I, HDRE-II, HDR-CAM"):
        Recipe.named("HDRE-III")


@pytest.mark.parametrize(
    "data",
    [
        "no json",
        {"format": "other"},
        {"format": "edgewatch-recipe/1", "name": "x", "operations": []},
        {"format": "edgewatch-recipe/1", "name": "x", "operations": [{"operation": "fft"}]},
        {"format": "edgewatch-recipe/1", "name": "x", "operations": [{"operation": "msnn", "q": 1}]},
        {"format": "edgewatch-recipe/1", "name": "x", "operations": [{"operation": "glt", "p": "half"}]},
    ],
)
def test_json_that_is_no_recipe_is_refused(data: object) -> None:
    with pytest.raises(BadInput):
        Recipe.from_json(data)


def test_orders_without_meaning_are_refused() -> None:
    with pytest.raises(BadInput, match="end with msnn, cog"):
        Recipe("x", (Line(),))
    with pytest.raises(BadInput, match="glt must come after hdre"):
        Recipe("x", (Tone(), Exposure(), Line(), Centroid()))
    with pytest.raises(BadInput, match="once"):
        Recipe("x", (Compound(), Compound(), Line(), Centroid()))


@pytest.mark.parametrize(
    ("recipe", "stack", "sentence"),
    [
        ("HDRE-II", header((0.0,), "logarithmic"), "linear camera but the stack is logarithmic; use HDR-CAM"),
        ("HDR-CAM", header(), "logarithmic camera but the stack is linear; use PRECISE"),
        ("HDRE-I", header((100.0,)), "only 100 us"),
        ("HDRE-I", header((0.0, 100.0)), "divides by the exposure time"),
    ],
)
def test_a_recipe_refuses_a_stack_it_cannot_read(recipe: str, stack: StackHeader, sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence):
        Recipe.named(recipe).check_fits(stack)


def test_an_exposure_that_was_not_recorded_is_refused_with_those_that_were() -> None:
    with pytest.raises(BadInput, match="100, 300 us"):
        Recipe.named("NF").with_settings({"exposure": "200"}).check_fits(header())
    with pytest.raises(BadInput, match="100, 300 us"):
        Recipe.named("HDRE-II").with_settings({"exposures": "100,200"}).check_fits(header())
