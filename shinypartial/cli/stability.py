"""The command that finds out how far methods bear worse data."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import tyro

from shinypartial.cli.suite import Suite
from shinypartial.suites.jobs import Size
from shinypartial.suites.stability.plan import SIZE, Plans


@dataclass(frozen=True)
class Stability(Suite):
    """Fit methods on data that get worse step by step: axes × levels × scenes × seeds, run by Snakemake.

    Run again to continue where an earlier run stopped. Words after -- go to Snakemake, such as its --executor.
    """

    FIRST: ClassVar = "snakemake cores collect_only plan methods scenes axes seeds output page"
    plan: Plans = "core"
    """The core axes; all axes; clean data alone, for the spread over many --seeds; or a tiny plan without rendering."""
    methods: tuple[str, ...] = ("fast",)
    """Presets of panoless: fast, default and paper."""
    method: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Another method as NAME='COMMAND {dataset} {prediction} {seed}'; may be given several times."""
    scenes: tuple[str, ...] = ()
    """Names of scenes, any of blender_scenes; those of the plan when not given."""
    axes: tuple[str, ...] = ()
    """Names of axes; those of the plan when not given."""
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of what is drawn by chance, in the copies and in the methods."""
    size: tyro.conf.OmitArgPrefixes[Size] = SIZE
    output: Path = Path("stability")
    """Folder of datasets, predictions and logs."""
    page: Path | None = None
    """Page to write, such as docs/stability.md, with numbers and pictures beside it; OUTPUT/stability.md by default."""

    join: tuple[Path, ...] = ()
    """Numbers of other runs, such as docs/results/stability.json, whose further cells the page shows, too."""

    def run(self) -> None:
        """Run the plan, collect it and write the page."""
        from shinypartial.suites.stability.collect import collect, join_results, read_results
        from shinypartial.suites.stability.page import write_stability_page
        from shinypartial.suites.stability.plan import make_plan, parse_methods

        others = tuple(map(read_results, self.join))
        methods = parse_methods(self.methods, self.method)
        plan = make_plan(self.plan, methods, self.seeds, scenes=self.scenes, axes=self.axes, size=self.size)
        results = self._collected(self.output, plan, collect)
        if results is None:
            return
        page = self.page or self.output / "stability.md"
        write_stability_page(page, self.output, join_results(results, others))
        print(f"Page: {page}")
