"""Gauge pairs that cannot be used are refused with one sentence that names the file, the line and the fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from scanning.calibration import calibrate, read_calibration, read_pairs
from scanning.errors import BadInput

GOOD = "height_mm,column_px\n0.14,9.152\n0.25,17.9658\n0.36,25.72\n0.44,29.8984\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("height_mm,column_px\n140,9.152\n250,17.9658\n360,25.72\n", "write heights in mm, not um"),
        ("\n \n", "is empty"),
        ("height,column_px\n1,2\n2,3\n3,4\n", "has no column height_mm"),
        ("height_mm,pixel\n1,2\n2,3\n3,4\n", "has no column column_px"),
        ("0.14,9.152\n0.25,17.9\n0.36,25.7\n", "has no column height_mm"),
        ("height_mm,column_px,column_px\n1,2,3\n", "more than one column column_px"),
        ("height_mm,column_px\n0.14,9\n0.25,\n0.36,25\n", "line 3: column_px is missing"),
        ("height_mm,column_px\n0.14,9\n0.25\n0.36,25\n", "line 3: column_px is missing"),
        ("height_mm,column_px\n0.14,9\n0.25,NaN\n0.36,25\n", 'line 3: column_px is "NaN", not a finite number'),
        ("height_mm,column_px\n0.14,9\ninf,18\n0.36,25\n", 'line 3: height_mm is "inf", not a finite number'),
        ("height_mm,column_px\n0.14,9\n0.25,1e999\n0.36,25\n", 'column_px is "1e999", not a finite number'),
        ("height_mm,column_px\n0.14,9\nabout a quarter,18\n0.36,25\n", '"about a quarter", not a number'),
        ("height_mm,column_px\n0.14,9\n0.25,1_8\n0.36,25\n", '"1_8", not a number'),
        ("height_mm,column_px\n", "0 pairs are too few"),
        ("height_mm,column_px\n0.14,9\n0.25,18\n", "2 pairs are too few"),
        ("height_mm,column_px\n0.14,9\n0.25,9\n0.36,9\n", "only 1 different column_px in 3 pairs"),
        ("height_mm,column_px\n0.14,9\n0.25,9\n0.36,12\n", "only 2 different column_px in 3 pairs"),
        ("height_mm,column_px\n0.14,9\n0.14,10\n0.14,12\n", "only 1 different height_mm in 3 pairs"),
        ("height_mm,column_px\n1,1\n2,2e307\n3,1e308\n", "no line fits"),
        ("height_mm,column_px\n1,1\n2,0\n1,-1\n3,0\n2,2\n2,-2\n", "no line fits"),
    ],
)
def test_a_broken_file_is_named_with_its_fault(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "pairs.csv"
    path.write_text(text)
    with pytest.raises(BadInput) as caught:
        read_calibration(path)
    assert said in str(caught.value)
    assert "pairs.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"nowhere\.csv cannot be read \(No such file or directory\)"):
        read_calibration(tmp_path / "nowhere.csv")


def test_a_picture_is_not_a_calibration(tmp_path: Path) -> None:
    (tmp_path / "pairs.csv").write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe")
    with pytest.raises(BadInput, match="is not text"):
        read_calibration(tmp_path / "pairs.csv")


@pytest.mark.parametrize("text", ["{", "{}", '{"format": "edgewatch-calibration/1"}'])
def test_a_broken_json_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "cal.json").write_text(text)
    with pytest.raises(BadInput, match=r"cal\.json"):
        read_calibration(tmp_path / "cal.json")


def test_unequal_lists_are_refused() -> None:
    with pytest.raises(BadInput, match="3 heights but 2 columns"):
        calibrate([1, 2, 3], [1, 2])


@pytest.mark.parametrize(
    "text",
    [
        GOOD,
        "\ufeff" + GOOD,
        GOOD.replace("\n", "\r\n"),
        GOOD.replace(",", ";"),
        GOOD.replace(",", ";").replace(".", ","),
        "sep=;\n" + GOOD.replace(",", ";").replace(".", ","),
        GOOD.replace(",", "\t"),
        GOOD.replace("height_mm,column_px", " Height_mm , COLUMN_PX "),
        GOOD + "\n,\n",
        "note,column_px,height_mm\na,9.152,0.14\nb,17.9658,0.25\nc,25.72,0.36\nd,29.8984,0.44\n",
    ],
)
def test_every_way_a_spreadsheet_writes_it_is_understood(text: str) -> None:
    assert read_pairs(text) == ([0.14, 0.25, 0.36, 0.44], [9.152, 17.9658, 25.72, 29.8984])
