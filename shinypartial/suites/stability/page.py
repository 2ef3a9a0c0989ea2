"""The page: losses, levels at which methods are lost, curves, and how well verdicts find lost fits."""

import math
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path

from shinypartial.io.files import write_text
from shinypartial.suites.stability.axes import Axis
from shinypartial.suites.stability.collect import (
    LOST_DB,
    REFUSED,
    Judged,
    Results,
    judged,
    limits,
    mean,
    verdict_auroc,
    write_results,
)
from shinypartial.suites.stability.figures import write_curves, write_pictures
from shinypartial.suites.stability.plan import TINY

RESULTS, ASSETS = Path("results/stability.json"), Path("assets")
SPLITS = ("development", "held-out")
VERDICTS = ("trust", "partly", "do not trust")


def write_stability_page(page: Path, suite: Path, results: Results) -> None:
    """Write the page with its numbers and pictures beside it; the same results give the same files."""
    write_results(page.parent / RESULTS, results)
    assets = page.parent / ASSETS
    for axis in results.axes:
        write_curves(assets / f"stability-{axis.name}.svg", results, axis)
    pictures = write_pictures(assets, suite, results, results.methods[0])
    write_text(page, "\n".join(page_lines(results, pictures)) + "\n")


def page_lines(results: Results, pictures: Sequence[tuple[str, str]]) -> Iterator[str]:
    """The page as Markdown."""
    size = results.size
    seeds = len({each.cell.seed for each in results.outcomes})
    yield from ("# Stability", "")
    counts = (_count(len(results.scenes), "scene"), _count(len(results.methods), "method"), _count(seeds, "seed"))
    yield f"{_count(len(results.outcomes), 'fit')} to photographs that are worse step by step: {', '.join(counts)}."
    if TINY not in results.scenes:
        yield f"Datasets have {size.train} training views of {size.resolution} × {size.resolution} pixels."
    yield from ("", f"- Scenes: {', '.join(results.scenes)}", f"- Methods: {', '.join(_methods(results))}")
    yield f"- Numbers: [{RESULTS.name}]({RESULTS.as_posix()}), made with this page by `shinypartial stability --page`"
    yield from ("", "Environment: PSNR of linear light over the directions that the true training views observe.")
    yield "Normals: pooled over pixels of test views that see the environment."
    if results.axes:
        yield from ("", "## Losses", "", *_loss_table(results))
        yield from ("", "## Limits", "", *_limit_table(results))
        text = "Means over scenes; the band is the range over seeds. Failed fits are left out."
        yield from ("", "## Curves", "", text)
    for axis in results.axes:
        yield from ("", f"![Curves: {axis.title}]({ASSETS.as_posix()}/stability-{axis.name}.svg)")
    if seeds > 1:
        yield from ("", "## Spread over seeds", "", *_spread_lines(results))
    yield from ("", "## Verdicts", "", *_verdict_lines(results))
    if pictures:
        yield from ("", "## Maps")
        for name, caption in pictures:
            yield from ("", f"![Environment maps: {caption}]({ASSETS.as_posix()}/{name})")
    failed = [each for each in results.outcomes if each.failure]
    if failed:
        yield from ("", "## Failed fits", "", "| Fit | Last line |", "| --- | --- |")
        yield from (f"| {each.cell.name} | {_escaped(each.failure)} |" for each in failed)


def _methods(results: Results) -> Iterator[str]:
    """Their names, with the scenes of those that were not fitted to all."""
    for method in results.methods:
        scenes = list(dict.fromkeys(each.cell.scene for each in results.outcomes if each.cell.method == method))
        yield method if len(scenes) == len(results.scenes) else f"{method} ({', '.join(scenes)} only)"


def _loss_table(results: Results) -> Iterator[str]:
    method = results.methods[0]
    yield f"Loss of the environment by {method} in dB, against the clean fit of the scene, whose level is in the first"
    yield f"row. Losses of {LOST_DB:g} dB and more are bold, gains negative."
    yield ""
    yield f"| | {' | '.join(results.scenes)} |"
    yield "|---" * (1 + len(results.scenes)) + "|"
    outcomes = [each for each in results.outcomes if each.cell.method == method and each.cell.axis is None]
    clean = {name: mean(each.environment_db for each in outcomes if each.cell.scene == name) for name in results.scenes}
    yield f"| Clean | {' | '.join('–' if each is None else f'{each:.2f}' for each in clean.values())} |"
    for axis in results.axes:
        found = {scene: results.along(axis, method, scene) for scene in results.scenes}
        for position in sorted({each for levels in found.values() for each in levels if each > 0}):
            values = {name: mean(each.environment_db for each in found[name].get(position, [])) for name in clean}
            cells = [_loss_text(clean[name], value) for name, value in values.items()]
            yield f"| {axis.title}: {axis.text(position).strip()} | {' | '.join(cells)} |"


def _loss_text(clean: float | None, value: float | None) -> str:
    if clean is None or value is None:
        return "–"
    loss = clean - value
    text = f"{round(loss, 1) + 0.0:.1f}"
    return f"**{text}**" if loss >= LOST_DB else text


def _limit_table(results: Results) -> Iterator[str]:
    yield f"Level at which the environment loses {LOST_DB:g} dB, linear between levels: median over scenes, with the"
    yield "range. A level without a result counts as lost. A dash: not within the levels."
    yield ""
    yield f"| Axis | {' | '.join(results.methods)} |"
    yield "|---" * (1 + len(results.methods)) + "|"
    for axis in results.axes:
        cells = [_limit_text(axis, limits(results, axis, method)) for method in results.methods]
        yield f"| {axis.title} | " + " | ".join(cells) + " |"


def _limit_text(axis: Axis, positions: Sequence[float | None]) -> str:
    if not positions:
        return "not run"
    ordered = sorted(math.inf if each is None else each for each in positions)
    texts = ["–" if math.isinf(each) else axis.text(each) for each in (ordered[0], ordered[-1])]
    middle = statistics.median_low(ordered)
    median = "–" if math.isinf(middle) else axis.text(middle)
    return median if texts[0] == texts[1] else f"{median} ({texts[0]} to {texts[1]})"


def _spread_lines(results: Results) -> Iterator[str]:
    yield "Standard deviation over seeds on clean data, of the environment and of the normals' mean error."
    yield ""
    yield "| Scene | Method | Seeds | Environment | Normals |\n|---|---|---|---|---|"
    for scene in results.scenes:
        for method in results.methods:
            clean = [each for each in results.outcomes if each.cell.axis is None and not each.failure]
            fits = [each for each in clean if (each.cell.scene, each.cell.method) == (scene, method)]
            decibels = [each.environment_db for each in fits if each.environment_db is not None]
            degrees = [each.normals_mean_deg for each in fits if each.normals_mean_deg is not None]
            texts = [
                f"{statistics.stdev(values):.3f}{unit}" if len(values) > 1 else "–"
                for values, unit in ((decibels, " dB"), (degrees, "°"))
            ]
            yield f"| {scene} | {method} | {len(fits)} | {' | '.join(texts)} |"


def _verdict_lines(results: Results) -> Iterator[str]:
    clean = [each for each in results.outcomes if each.cell.axis is None and each.verdict == REFUSED]
    refused = dict.fromkeys(f"{each.cell.scene} with {each.cell.method}" for each in clean)
    yield f"A fit is *lost* where its environment is {LOST_DB:g} dB or more worse than that of the clean fit of the"
    yield "same scene, method and seed. AUROC: the chance that a lost fit states a higher risk than one that is"
    yield "not lost. Left out: fits without a risk, and those whose clean fit is refused,"
    yield f"{', '.join(refused) or 'none'}."
    yield ""
    yield "| Scenes | Method | Fits | Lost | AUROC of the risk |\n|---|---|---|---|---|"
    groups = {split: list(judged(results, split)) for split in SPLITS}
    for split, fits in groups.items():
        for method in results.methods:
            own = [each for each in fits if each.outcome.cell.method == method]
            area = verdict_auroc(own)
            if own:
                text = "–" if area is None else f"{area:.3f}"
                yield f"| {split} | {method} | {len(own)} | {sum(each.lost for each in own)} | {text} |"
    main = results.methods[0]
    yield ""
    headings = [f"{split}: {word}" for split in SPLITS for word in ("kept", "lost")]
    yield f"| Verdict of {main} | " + " | ".join(headings) + " |"
    yield "|---" * (1 + len(headings)) + "|"
    for verdict in VERDICTS:
        counts = (_counted(groups[split], main, verdict, lost) for split in SPLITS for lost in (False, True))
        yield f"| {verdict} | " + " | ".join(map(str, counts)) + " |"


def _counted(fits: Sequence[Judged], method: str, verdict: str, lost: bool) -> int:
    outcomes = (each.outcome for each in fits if each.lost == lost)
    return sum((each.cell.method, each.verdict) == (method, verdict) for each in outcomes)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")
