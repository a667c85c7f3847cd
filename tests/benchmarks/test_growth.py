"""Growth of time and memory: page and picture are of the rows that are kept, their exponents within the limit."""

import sys
from pathlib import Path

import pytest
from scripts import run_here

sys.path.insert(0, str(Path(__file__).parent))
import growth

HERE = Path(__file__).parent
DOCS = HERE.parents[1] / "docs"
ROWS = growth.stored(HERE / "growth.csv")
ASKED = {"poses": (100, 100_000), "samples": (1_000, 600_000), "joints": (3, 30), "candidates": (200, 20_000)}


def test_page_is_of_the_kept_rows():
    page = (DOCS / "growth.md").read_text(encoding="utf-8")
    assert growth.written(page, ROWS) == page


def test_picture_is_of_the_kept_rows():
    assert growth.digest(ROWS).encode() in (DOCS / "growth.png").read_bytes()


@pytest.mark.parametrize("about", ASKED)
def test_rows_reach_the_sizes_asked_for(about):
    sizes = [growth.growth(curve, ROWS).sizes for curve in growth.CURVES if curve.about == about and not curve.peer]
    assert min(one[0] for one in sizes) <= ASKED[about][0]
    assert all(one[-1] >= ASKED[about][1] for one in sizes)


def test_nothing_grows_faster_than_its_work():
    """Nothing of ours grows faster than its work."""
    assert growth.above_limit(ROWS) == []


def test_exponent_is_of_the_upper_sizes():
    """A start-up constant at small sizes does not count; a cost that grows too fast is named."""
    curve = next(one for one in growth.CURVES if one.work == "fit_poses")
    rows = [growth.Row(*curve[:2], n, 1e-3 * n**1.3 if n > 1000 else 5.0, 100.0) for n in growth.SIZES["poses"]]
    found = growth.growth(curve, rows)
    assert found.exponent == pytest.approx(1.3) and found.sigma == pytest.approx(0.0, abs=1e-12)
    assert growth.above_limit(rows) == [f"poses, {curve.name}: cpu 1.30"]


def test_goes_on_after_a_killed_run(tmp_path, monkeypatch):
    """Rows that are there are not measured again, except with --again; those without a peer are."""
    done = []

    def measured(curve, size):
        done.append((curve.work, size))
        if len(done) == 4:
            raise KeyboardInterrupt
        return growth.Row(*curve[:2], size, None if curve.peer else 1.0, None if curve.peer else 1.0, "not installed")

    monkeypatch.setattr(growth, "measured", measured)
    options = {"again": False, "largest": False, "most": 25}
    with pytest.raises(KeyboardInterrupt):
        growth.run(tmp_path / "rows.csv", ["parameters"], **options)
    growth.run(tmp_path / "rows.csv", ["parameters"], **options)
    ours, theirs = "fit_parameters", "scipy_parameters"
    first = [(ours, 13), (theirs, 13), (ours, 20), (theirs, 20)]
    assert done == [*first, (theirs, 13), (theirs, 20), (ours, 25), (theirs, 25)]
    growth.run(tmp_path / "rows.csv", ["parameters"], **(options | {"again": True, "most": 13}))
    assert done[8:] == [(ours, 13), (theirs, 13)]


@pytest.mark.slow
def test_fresh_run(tmp_path, capsys):
    out, page = tmp_path / "rows.csv", tmp_path / "page.md"
    page.write_text("\n".join(f"<!-- {about} --><!-- end -->" for about in growth.SIZES))
    said = run_here(
        HERE / "growth.py", "--out", out, "--only", "parameters", "--most", "20", "--page", page,
        "--picture", tmp_path / "growth.png", capsys=capsys,
    )  # fmt: skip
    rows = growth.stored(out)
    assert [row.size for row in rows] == [13, 20] * 2 and all(row.cpu > 0 and row.memory > 20 for row in rows)
    lines = list(growth.table("parameters", rows))
    assert all(line in said and line in page.read_text() for line in lines)
    assert growth.digest(rows).encode() in (tmp_path / "growth.png").read_bytes()
