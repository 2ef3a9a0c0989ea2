"""The command that makes the paper's tables."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, get_args

import tyro

from shinypartial.cli.suite import Suite
from shinypartial.suites.jobs import Size
from shinypartial.suites.tables.plan import SIZE, TableName


@dataclass(frozen=True)
class Tables(Suite):
    """Make the paper's tables with our figures beside its own: render, fit, score and write a page, run by Snakemake.

    Run again to continue where an earlier run stopped. Words after -- go to Snakemake, such as its --executor.
    """

    FIRST: ClassVar = "snakemake cores collect_only tables scenes methods seeds output page missing"
    tables: tuple[TableName, ...] = get_args(TableName)
    """Which of them."""
    scenes: tuple[str, ...] = ()
    """Names of scenes; those of the tables when not given."""
    methods: tuple[str, ...] = ()
    """Rows, such as ours, oracle-baseline and 3dgs-dr; all when not given."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the methods, and of what is drawn by chance in copies."""
    size: tyro.conf.OmitArgPrefixes[Size] = SIZE
    schedule: str = ""
    """Options of `panoless fit` for the paper's method and those that it compares with, which else take their whole
    schedules: --schedule="--config.iterations 3000 --config.surfels.count 3000". The page states them."""
    output: Path = Path("tables")
    """Folder of datasets, predictions and logs."""
    page: Path | None = None
    """Page to write, such as docs/results/tables.md, with numbers beside it, which keep what an earlier run left there;
    OUTPUT/tables.md by default."""
    missing: bool = False
    """Only the cells that the page's numbers lack, where it was begun on another machine or its folder is gone."""

    def run(self) -> None:
        """Run the plan, collect it and write the page."""
        from shinypartial.suites.tables.collect import collect, read_measured
        from shinypartial.suites.tables.page import numbers_of, write_tables_page
        from shinypartial.suites.tables.plan import make_plan

        page = self.page or self.output / "tables.md"
        plan = make_plan(
            self.tables,
            self.seeds,
            self.size,
            scenes=self.scenes,
            methods=self.methods,
            schedule=self.schedule,
            without=read_measured(numbers_of(page)) if self.missing else (),
        )
        if not plan.cells:
            print(f"{page} has every cell of these tables")
            return
        results = self._collected(self.output, plan, collect)
        if results is None:
            return
        write_tables_page(page, results)
        print(f"Page: {page}")
