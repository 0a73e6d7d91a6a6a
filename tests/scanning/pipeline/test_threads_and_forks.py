"""The same frames give the same numbers in one thread, in two at once, in a forked child and in a thread of that.

The rig's worker is a forked Celery child and the live view reads from a thread. A thread pool inside a kernel would
hang in the first and corrupt scratch in the second.
"""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.typing import NDArray

from scanning.pipeline import warm_up
from scanning.pipeline.line import extract_line
from scanning.recipe import Recipe
from tests.scanning.pipeline.agreement import Steps, header_for, product
from tests.scanning.pipeline.scenes import line, shot

TIMES = (100.0, 300.0)
Columns = NDArray[np.float64]


@pytest.fixture(scope="module")
def steps() -> Steps:
    rng = np.random.default_rng(4)
    centre = 60.0 + 0.05 * np.arange(200)
    return [[shot(line(centre, 128, 3.03, 60.0 * t / 100.0), rng) for t in TIMES] for _ in range(8)]


def columns(steps: Steps, name: str) -> Columns:
    recipe = Recipe.named(name)
    few = steps if recipe.hdre is not None else [images[:1] for images in steps]
    return product(few, header_for(few, TIMES if recipe.hdre is not None else TIMES[:1]), recipe)


@pytest.mark.parametrize("name", ["NF", "SCI", "HDRE-II", "PRECISE"])
def test_two_threads_at_once_give_what_one_gives(steps: Steps, name: str) -> None:
    expected = columns(steps, name)
    together = threading.Barrier(2, timeout=60)

    def one(_: int) -> Columns:
        together.wait()
        return columns(steps, name)

    with ThreadPoolExecutor(2) as pool:
        for _ in range(3):
            for found in pool.map(one, range(2)):
                assert np.array_equal(found, expected, equal_nan=True)


def _in_a_thread(steps: Steps, name: str) -> Columns:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(columns, steps, name).result(timeout=60)


@pytest.mark.parametrize("work", [columns, _in_a_thread], ids=["the child", "a thread of the child"])
def test_a_forked_child_gives_what_its_parent_gives(steps: Steps, work: Callable[[Steps, str], Columns]) -> None:
    expected = columns(steps, "HDRE-II")
    with multiprocessing.get_context("fork").Pool(1) as pool:
        found = pool.apply_async(work, (steps, "HDRE-II")).get(timeout=60)
    assert np.array_equal(found, expected, equal_nan=True)


def test_warming_up_tells_how_far_it_is() -> None:
    told: list[tuple[int, int]] = []
    warm_up(lambda done, total: told.append((done, total)))
    assert [done for done, _ in told] == list(range(1, told[-1][1] + 1))


def test_after_warming_up_a_scan_compiles_nothing(steps: Steps) -> None:
    warm_up()
    before = set(extract_line.signatures)
    for name in ("NF", "SCI", "HDRE-I", "HDRE-II", "PRECISE"):
        columns(steps, name)
    assert set(extract_line.signatures) == before
