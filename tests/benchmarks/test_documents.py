"""The tables of documents, from made-up rows in a made-up checkout."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from benchmarks import __main__ as bench
from benchmarks import documents, plots

OPENING = "<!-- table: {} -->"
CLOSING = "<!-- end -->"
SWEEP = {
    "kind": "sweep",
    "rows": ["sweep.jsonl"],
    "labels": {"T1": "× 1", "T2": "× 2"},
    "scenes": {"fox": ["fox"], "castle": ["castle", "castle-2"]},
}
RUNS = {
    "kind": "runs",
    "columns": ["photos", "method", "loop", "ratio", "psnr", "gaussians"],
    "lines": [
        {"rows": "runs.jsonl", "scenes": ["fox"], "labels": {"slow": "slow", "ours": "ours"}, "reference": "slow"},
        {"rows": "runs.jsonl", "scenes": ["tree"], "labels": {"ours": "ours, elsewhere"}},
    ],
}


def row(scene: str, label: str, seed: int = 0, **changes: Any) -> dict[str, Any]:
    return {
        "key": f"{scene}/{label}/{seed}", "scene": scene, "label": label, "seed": seed, "status": "ok",
        "train_views": 43, "loop_seconds": 10.0, "psnr": 30.0,
        "ssim": 0.9, "lpips": 0.1, "gaussians": 200_000, "peak_gb": 1.0, **changes,
    }  # fmt: skip


ROWS = {
    "runs.jsonl": [
        row("fox", "slow", loop_seconds=250.0, psnr=29.0, gaussians=9_999),
        row("fox", "ours", 0, psnr=30.0),
        row("fox", "ours", 1, psnr=31.0, loop_seconds=11.0),
        row("tree", "ours"),
        row("tree", "ours", 1, status="failed", psnr=None),
        row("tree", "bare", train_views=None),
    ],
    "sweep.jsonl": [
        row("fox", "T1", 0), row("fox", "T1", 1, psnr=30.5),
        row("fox", "T2", 0, psnr=30.0, ssim=0.91, lpips=0.09, gaussians=300_000),
        row("fox", "T2", 1, psnr=30.0, ssim=0.91, lpips=0.09, gaussians=300_000),
        row("castle", "T1", psnr=28.0), row("castle-2", "T1", psnr=30.0), row("castle", "T2", psnr=27.0),
    ],
}  # fmt: skip


def checkout(folder: Path, tables: Any, rows: dict[str, list[dict[str, Any]]], **texts: str) -> Path:
    """A checkout whose README holds all tables, still empty."""
    results = folder / documents.RESULTS
    results.mkdir(parents=True)
    content = {"megapixels": {"fox": 0.68}, "tables": tables}
    (results / documents.TABLES).write_text(yaml.safe_dump(content, allow_unicode=True, sort_keys=False), "utf8")
    for name, lines in rows.items():
        (results / name).write_text("".join(json.dumps(line) + "\n" for line in lines), "utf8")
    marked = "\n\n".join(f"{OPENING.format(name)}\n{CLOSING}" for name in tables)
    (folder / "README.md").write_text(f"# Title\n\n{marked}\n\nAfter.\n", "utf8")
    for name, text in texts.items():
        (folder / "docs" / f"{name}.md").write_text(text, "utf8")
    return folder


def test_runs_are_a_line_each(tmp_path: Path):
    folder = checkout(tmp_path, {"main": RUNS}, {"runs.jsonl": ROWS["runs.jsonl"]})
    status = bench.main(["documents", str(folder)])
    assert status == 0
    actual = (folder / "README.md").read_text("utf8")
    assert (
        actual
        == """# Title

<!-- table: main -->

| Scene: training views | Method | Loop s | Ratio | PSNR | Gaussians |
| --- | --- | ---: | ---: | ---: | ---: |
| fox: 43 of 0.68 MP | slow | 250.0 | 1 | 29.00 | 9,999 |
|  | ours | 10.0, 11.0 | 1/24 | 30.00, 31.00 | 200k |
| tree: 43 | ours, elsewhere | 10.0 | – | 30.00 | 200k |

<!-- end -->

After.
"""
    )


def test_runs_may_lack_the_numbers_of_columns_that_are_named_and_of_no_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    rows = [row("fox", "without"), row("fox", "with", gain_psnr=31.0)]
    lines = [{"rows": "runs.jsonl", "scenes": ["fox"], "labels": {"without": "without", "with": "with"}}]
    tables = {"main": {"kind": "runs", "columns": ["method", "psnr", "gain_psnr"], "lines": lines}}
    folder = checkout(tmp_path / "strict", tables, {"runs.jsonl": rows})
    assert bench.main(["documents", str(folder)]) == 2
    assert "gain_psnr" in capsys.readouterr().err
    tables["main"]["may_be_missing"] = ["gain_psnr"]
    folder = checkout(tmp_path / "named", tables, {"runs.jsonl": rows})
    assert bench.main(["documents", str(folder)]) == 0
    written = (folder / "README.md").read_text("utf8")
    assert "| without | 30.00 | – |\n| with | 30.00 | 31.00 |" in written


def test_a_sweep_is_differences_from_its_first_setting(tmp_path: Path):
    folder = checkout(tmp_path, {"sweep": SWEEP}, {"sweep.jsonl": ROWS["sweep.jsonl"]})
    status = bench.main(["documents", str(folder)])
    assert status == 0
    lines = (folder / "README.md").read_text("utf8").splitlines()[6:10]
    # Castle is the mean of its two scenes; its second setting lacks one of them.
    assert lines[0] == "| × 1 | 30.25 / .9000 / .1000 / 200k | 29.00 / .9000 / .1000 / 200k |"
    assert lines[1] == "| standard deviation | .25 / .0000 / .0000 | – |"
    assert lines[2] == "| × 2 | −.25 / +.0100 / −.0100 / ×1.50 ² | – |"


def test_a_difference_that_rests_on_few_runs_is_marked(tmp_path: Path):
    rows = [row("fox", "T1", 0), row("fox", "T1", 1), row("fox", "T2", lpips=0.1 - 1e-9)]
    folder = checkout(tmp_path, {"sweep": {**SWEEP, "scenes": {"fox": ["fox"]}}}, {"sweep.jsonl": rows})
    status = bench.main(["documents", str(folder)])
    assert status == 0
    assert "| × 2 | .00 / .0000 / .0000 / ×1.00 ¹ |" in (folder / "README.md").read_text("utf8")


def test_kernels_and_starts_are_tables_of_their_rows(tmp_path: Path):
    ok = {"scene": "fox", "status": "ok"}
    kernel = {**ok, "label": "adam", "by": "torch", "ratio": 1.25, "launches": 40.0}
    start = {**ok, "label": "sadgs", "first": True, "wait": 9.0, "seconds": 20.0}
    tables = {"kernels": {"kind": "kernels", "rows": "k.jsonl"}, "start": {"kind": "startup", "rows": "s.jsonl"}}
    folder = checkout(tmp_path, tables, {"k.jsonl": [kernel], "s.jsonl": [start]})
    status = bench.main(["documents", str(folder)])
    assert status == 0
    text = (folder / "README.md").read_text("utf8")
    assert "| adam | torch | 1.250 | 40 |" in text
    assert "| sadgs | 9.0 | 20.0 | – | – |" in text


def test_changes_are_ranges_over_scenes_and_captures_with_folds_between_texts(tmp_path: Path):
    change = {"rows": ["sweep.jsonl"], "change": ["T1", "T2"], "remark": "why"}
    lines = [
        {**change, "texts": ["× 2", "theirs"], "scenes": {"fox": ["fox"], "castle": ["castle"]}},
        {**change, "texts": ["× 2, fox", ""], "scenes": ["fox"]},
        {"texts": ["nothing", "theirs"], "remark": "no run"},
        {**change, "texts": ["without LPIPS", ""], "scenes": ["tree"]},
    ]
    rows = [*ROWS["sweep.jsonl"], row("tree", "T1", lpips=None), row("tree", "T2", psnr=31.0)]
    tables = {"claims": {"kind": "changes", "header": ["Claim", "Paper"], "remark": "Explanation", "lines": lines}}
    folder = checkout(tmp_path, tables, {"sweep.jsonl": rows})
    status = bench.main(["documents", str(folder)])
    assert status == 0
    actual = (folder / "README.md").read_text("utf8").splitlines()[4:10]
    expected = [
        "| Claim | Paper | PSNR / SSIM / LPIPS / Gaussians | Spread | Scenes × seeds | Explanation |",
        "| --- | --- | --- | --- | --- | --- |",
        "| × 2 | theirs | −1.00 to −.25 / .0000 to +.0100 / −.0100 to .0000 / ×1.00 to 1.50 | .25 / .0000 / .0000 "
        "| 2 × 1 | why |",
        "| × 2, fox |  | −.25 / +.0100 / −.0100 / ×1.50 | .25 / .0000 / .0000 | 1 × 2 | why |",
        "| nothing | theirs | not measured | – | – | no run |",
        "| without LPIPS |  | +1.00 / .0000 / – / ×1.00 | – | 1 × 1 | why |",
    ]
    assert actual == expected


FIGURE = {
    "kind": "peers",
    "lines": [{"rows": "runs.jsonl", "scenes": ["fox"], "labels": {"slow": "theirs 30k", "ours": "ours"}}],
    "elsewhere": [{"rows": "runs.jsonl", "scenes": ["tree"], "labels": {"ours": "ours"}}],
}


def test_a_figure_is_drawn_from_its_rows_and_drawn_anew_only_when_they_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = checkout(tmp_path, {"main": RUNS}, {"runs.jsonl": ROWS["runs.jsonl"]})
    described = folder / documents.RESULTS / documents.TABLES
    described.write_text(
        described.read_text("utf8") + yaml.safe_dump({"figures": {"peers": FIGURE}}, sort_keys=False), "utf8"
    )
    path = folder / documents.FIGURES / "peers.png"
    status = bench.main(["documents", str(folder), "--check"])
    assert status == 1
    assert not path.exists()
    status = bench.main(["documents", str(folder)])
    assert status == 0
    digest = plots.digest_in(path)
    status = bench.main(["documents", str(folder), "--check"])
    assert status == 0
    rows = folder / documents.RESULTS / "runs.jsonl"
    rows.write_text(rows.read_text("utf8").replace("250.0", "251.0"), "utf8")
    written = path.read_bytes()
    capsys.readouterr()
    status = bench.main(["documents", str(folder), "--check"])
    assert status == 1
    assert path.read_bytes() == written
    printed = capsys.readouterr().out
    assert f"{path} is not what its rows give; run python -m benchmarks documents." in printed
    status = bench.main(["documents", str(folder)])
    assert status == 0
    assert path.read_bytes() != written
    assert digest is not None
    assert plots.digest_in(path) not in (digest, None)


def test_runs_of_several_settings_have_one_line_in_the_scenes_that_are_named(tmp_path: Path):
    rows = {
        "runs.jsonl": [row("fox", "ours"), row("tree", "ours")],
        "more.jsonl": [row("fox", "half", psnr=29.0, loop_seconds=5.0), row("tree", "half", loop_seconds=6.0)],
    }
    source = documents.Source(checkout(tmp_path, {}, rows) / documents.RESULTS, {})
    arguments = source.quality_drawn(
        list(rows), ["fox", "tree"], {"ours": "ours"}, joined={"both": ["half", "ours"]}, joined_scenes=["fox"]
    )
    panels = plots.quality(*arguments).axes
    dotted = []
    for place in (0, 3):  # The panels of PSNR, of fox and of tree
        lines = [line for line in panels[place].lines if line.get_linestyle() == ":"]
        dotted.append([np.asarray(line.get_xydata()).tolist() for line in lines])
    assert dotted == [[[[5.0, 29.0], [10.0, 30.0]]], []]


WRONG_FIGURES: dict[str, tuple[Any, str]] = {
    "an unknown key": ({**FIGURE, "cost": "price"}, "unexpected keyword argument 'cost'"),
    "an unknown label": (
        {**FIGURE, "elsewhere": [{**FIGURE["lines"][0], "labels": {"none": "none"}}]},
        "no row 'none'",
    ),
    "a missing key": ({"kind": "peers"}, "missing 1 required positional argument: 'lines'"),
    "a list": ([FIGURE], "figure peers: "),
    "a kind of table": ({**FIGURE, "kind": "sweep"}, "no attribute 'sweep_drawn'"),
}


@pytest.mark.parametrize("case", WRONG_FIGURES)
def test_a_figure_that_is_described_wrongly_is_one_sentence(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    figure, sentence = WRONG_FIGURES[case]
    folder = checkout(tmp_path, {"main": RUNS}, {"runs.jsonl": ROWS["runs.jsonl"]})
    described = folder / documents.RESULTS / documents.TABLES
    described.write_text(
        described.read_text("utf8") + yaml.safe_dump({"figures": {"peers": figure}}, sort_keys=False), "utf8"
    )
    status = bench.main(["documents", str(folder)])
    assert status == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
    assert not (folder / documents.FIGURES).exists()
    assert "fox" not in (folder / "README.md").read_text("utf8")


def test_check_finds_what_changed_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = checkout(tmp_path, {"main": RUNS}, {"runs.jsonl": ROWS["runs.jsonl"]})
    status = bench.main(["documents", str(folder), "--check"])
    assert status == 1
    status = bench.main(["documents", str(folder)])
    assert status == 0
    status = bench.main(["documents", str(folder), "--check"])
    assert status == 0
    capsys.readouterr()
    readme = folder / "README.md"
    wrong = readme.read_text("utf8").replace("29.00", "28.99")
    readme.write_text(wrong, "utf8")
    status = bench.main(["documents", str(folder), "--check"])
    assert status == 1
    printed = capsys.readouterr().out
    assert printed == f"{readme}: table main is not what its rows give; run python -m benchmarks documents.\n"
    assert readme.read_text("utf8") == wrong


WRONG: dict[str, tuple[Any, str, str]] = {
    "no table of that name": ({"main": RUNS}, "<!-- table: other -->\n<!-- end -->\n", "table other is not in"),
    "a table without end": ({"main": RUNS}, "<!-- table: main -->\n\n", "needs one `<!-- end -->`"),
    "an end alone": ({"main": RUNS}, "<!-- end -->\n", "needs one `<!-- end -->`"),
    "an unknown kind": ({"main": {**RUNS, "kind": "run"}}, "", "no attribute 'run'"),
    "an unknown key": ({"main": {**RUNS, "row": 1}}, "", "unexpected keyword argument 'row'"),
    "a missing key": ({"main": {"kind": "runs", "columns": []}}, "", "missing 1 required positional argument: 'lines'"),
    "an unknown column": ({"main": {**RUNS, "columns": ["speed"]}}, "", "there is no column 'speed'"),
    "a number that rows lack": (
        {"main": {**RUNS, "lines": [{"rows": "runs.jsonl", "scenes": ["tree"], "labels": {"bare": "bare"}}]}},
        "",
        "tree/bare/0 has no train_views",
    ),
    "an unknown label": ({"main": {**SWEEP, "rows": ["runs.jsonl"]}}, "", "have no row 'T1'"),
    "an unknown scene": (
        {"main": {**RUNS, "lines": [{"rows": "runs.jsonl", "scenes": ["site"], "labels": {"ours": "ours"}}]}},
        "",
        "there is no row 'ours' of site",
    ),
    "tables that are a list": ([RUNS], "", "must be YAML with mappings of megapixels and tables"),
    "scenes that are no mapping": ({"main": {**SWEEP, "scenes": ["fox"]}}, "", "table main: "),
    "no such rows": ({"main": {**SWEEP, "rows": ["none.jsonl"]}}, "", "none.jsonl is not there"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_sentence_and_changes_nothing(case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    tables, text, sentence = WRONG[case]
    folder = checkout(tmp_path, tables, {"runs.jsonl": ROWS["runs.jsonl"]}, zulu=text)
    before = (folder / "README.md").read_text("utf8")
    status = bench.main(["documents", str(folder)])
    assert status == 2
    error = capsys.readouterr().err
    assert error.startswith("python -m benchmarks documents: ")
    assert sentence in error
    assert error.count("\n") == 1
    assert (folder / "README.md").read_text("utf8") == before


def test_rows_that_no_table_cites_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = checkout(tmp_path, {"main": RUNS}, ROWS)
    status = bench.main(["documents", str(folder)])
    assert status == 2
    errors = capsys.readouterr().err
    assert "no table is made of sweep.jsonl" in errors


def test_a_table_that_no_document_holds_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = checkout(tmp_path, {"main": RUNS, "sweep": SWEEP}, ROWS)
    readme = folder / "README.md"
    readme.write_text(readme.read_text("utf8").replace(f"{OPENING.format('sweep')}\n{CLOSING}", ""), "utf8")
    status = bench.main(["documents", str(folder)])
    assert status == 2
    errors = capsys.readouterr().err
    assert "no document holds sweep" in errors


def test_a_folder_that_is_no_checkout_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    status = bench.main(["documents", str(tmp_path)])
    assert status == 2
    errors = capsys.readouterr().err
    assert "give a checkout's folder" in errors
