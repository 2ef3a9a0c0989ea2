"""What commands have in common whose plans Snakemake runs."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro


@dataclass(frozen=True)
class Suite:
    """How a plan is run."""

    snakemake: tyro.conf.Positional[tuple[str, ...]] = ()
    """Arguments of Snakemake, after --."""
    cores: int = 2
    """Jobs that run at once on this machine, each with one thread; rendering takes two cores."""
    retry: bool = False
    """Run jobs again that failed."""
    collect_only: bool = False
    """Run nothing; write the page of what is there."""

    def _collected(self, output: Path, plan: Any, collect: Callable[[Path, Any], Any]) -> Any:
        """What `collect` finds of the cells of a plan that have ended, after its jobs were run; None after a dry run.

        Raises InputError where none has ended, or one has by another command than the plan's.
        """
        from shinypartial.core.errors import InputError
        from shinypartial.suites.attempt import require_records
        from shinypartial.suites.run import run_suite

        print(f"{len(plan.cells)} cells, {len(plan.jobs)} jobs in {output}")
        require_records(output, plan)
        if not self.collect_only and not run_suite(output, plan, self.cores, self.snakemake, retry=self.retry):
            return None
        results = collect(output, plan)
        if not results.outcomes:
            raise InputError(
                expected=f"a finished cell in {output}",
                found="none",
                remedy="Run the same command without --collect-only.",
            )
        failed = sum(bool(each.failure) for each in results.outcomes)
        print(f"{len(results.outcomes)} of {len(plan.cells)} cells have ended, {failed} of them failed")
        return results
