"""Snakemake plans all jobs of the tables and begins none in a dry run."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest

from shinypartial.cli import main
from shinypartial.suites.tables.collect import Outcome, Results, write_results
from shinypartial.suites.tables.plan import SIZE, make_plan

needs_snakemake = pytest.mark.skipif(importlib.util.find_spec("snakemake") is None, reason="Snakemake is not installed")


@needs_snakemake
def test_a_dry_run_lists_every_job(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["tables", "--tables", "main", "pose-jitter", "--scenes", "vase", "--output", str(tmp_path)]
    words.append("--schedule=--config.iterations 60 --config.downscale 2")
    assert main([*words, "--", "--dry-run"]) == 0
    printed = "".join(capfd.readouterr())
    plan = make_plan(["main", "pose-jitter"], [0], scenes=["vase"])
    assert f"{len(plan.cells)} cells, {len(plan.jobs)} jobs" in printed
    for kind in ("render", "perturb", "fit", "score"):
        count = sum(job.name.startswith(f"{kind}/") for job in plan.jobs)
        assert printed.count(f"rule {kind}:") == count
    assert not (tmp_path / "records").exists()
    assert "--preset 3dgs-dr --config.iterations 60 --config.downscale 2 --config.seed 0" in (
        tmp_path / "plan.json"
    ).read_text(encoding="utf-8")


@needs_snakemake
def test_what_a_page_has_already_is_not_made_again(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    words = ["tables", "--tables", "main", "--methods", "ours", "--missing", "--page", str(page)]
    words += ["--output", str(tmp_path / "tables"), "--", "--dry-run"]
    plan = make_plan(["main"], [0], methods=["ours"])
    done, failed, _ = (Outcome(*cell.key) for cell in plan.cells)
    write_results(page.with_suffix(".json"), Results(SIZE, "", (done, replace(failed, failure="killed"))))
    assert main(words) == 0
    assert "2 cells, 6 jobs" in "".join(capfd.readouterr())
    write_results(page.with_suffix(".json"), Results(SIZE, "", tuple(Outcome(*cell.key) for cell in plan.cells)))
    assert main(words) == 0
    assert "has every cell" in "".join(capfd.readouterr())
