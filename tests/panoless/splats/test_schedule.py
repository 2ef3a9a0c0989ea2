"""When things happen: shares scale with the length of the fit, and the paper preset has the published numbers."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import pytest

from panoless.config import FitConfig
from panoless.presets import PRESETS
from panoless.splats.descent import PUBLISHED, Rates
from panoless.splats.schedule import DROP_AT, DROP_FACTOR, Schedule

PERIODIC = ("density_round", "opacity_reset", "propagation")


@cache
def events(config: FitConfig, name: str) -> list[int]:
    """Iterations after which something happens."""
    ask = getattr(Schedule(config), name)
    return [iteration for iteration in range(config.splats.iterations) if ask(iteration)]


@pytest.mark.parametrize("name", PERIODIC)
@pytest.mark.parametrize("times", [2, 3])
def test_periodic_events_scale_with_the_length(name: str, times: int) -> None:
    config = replace(PRESETS["paper"], splats=replace(PRESETS["paper"].splats, iterations=4500))
    longer = replace(config, splats=replace(config.splats, iterations=4500 * times))
    assert events(longer, name) == [times * iteration for iteration in events(config, name)] != []


@pytest.mark.parametrize("preset", [name for name, each in PRESETS.items() if each.splats.surfels.shading == "mirror"])
def test_phases_scale_with_the_length(preset: str) -> None:
    short, long = (
        Schedule(replace(PRESETS[preset], splats=replace(PRESETS[preset].splats, iterations=iterations)))
        for iterations in (3000, 6000)
    )
    for iteration in range(3000):
        for name in ("geometry_moves", "lambda_silhouette"):
            assert getattr(long, name)(2 * iteration) == getattr(short, name)(iteration)
    # The fall of the rates is finer in a longer fit: half a step is 0.2 %.
    later = [long.rate_factor(2 * iteration) for iteration in range(3000)]
    assert later == pytest.approx([short.rate_factor(iteration) for iteration in range(3000)], rel=0.01)


def test_the_paper_preset_has_the_published_schedule() -> None:
    config = PRESETS["paper"]
    schedule = Schedule(config)
    assert config.splats.iterations == 45_000
    assert events(config, "density_round") == list(range(500, 12_000, 100))
    assert events(config, "opacity_reset") == [3000, 6000, 9000]
    assert (schedule.lambda_silhouette(2999), schedule.lambda_silhouette(3000)) == (1.0, 0.0)
    assert schedule.geometry_moves(0)
    rates = Rates.of(config, unit=3.0)
    assert (rates.square_memory, rates.by_name["means"]) == (0.999, pytest.approx(3 * 1.6e-4))
    assert {schedule.rate_factor(iteration) for iteration in (0, 20_000, 44_999)} == {1.0}


def test_normals_propagate_only_while_the_outline_is_held() -> None:
    """Every round widens the outline, and after the silhouette term nothing takes that back."""
    schedule = Schedule(PRESETS["paper"])
    assert all(schedule.lambda_silhouette(iteration) > 0 for iteration in events(PRESETS["paper"], "propagation"))


def test_the_means_slow_down_to_a_hundredth_as_in_the_papers_code() -> None:
    schedule, default = Schedule(PRESETS["paper"]), Schedule(PRESETS["default"])
    found = [schedule.means_factor(iteration) for iteration in (0, 15_000, 30_000, 44_999)]
    assert found == pytest.approx([1.0, 0.1, 0.01, 0.01])
    assert {default.means_factor(iteration) for iteration in (0, 500, 999)} == {1.0}


def test_propagation_never_meets_a_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    config = PRESETS["paper"]
    assert events(config, "propagation") == [1000, 2000]
    monkeypatch.setitem(PUBLISHED, "mirror", replace(PUBLISHED["mirror"], propagates_until=45_000))
    schedule = Schedule(config)
    propagations = [iteration for iteration in range(0, 45_000, 500) if schedule.propagation(iteration)]
    assert propagations == [1000, 2000, 4000, 5000, 7000, 8000, 10_000, 11_000]
    assert not set(propagations) & set(events(config, "opacity_reset"))


def test_nothing_happens_without_density_control() -> None:
    config = replace(
        PRESETS["paper"],
        splats=replace(
            PRESETS["paper"].splats, iterations=4500, density=replace(PRESETS["paper"].splats.density, enabled=False)
        ),
    )
    assert [events(config, name) for name in PERIODIC] == [[], [], []]


def test_the_rates_are_constant_and_then_fall_to_the_drop_factor() -> None:
    config = replace(PRESETS["default"], splats=replace(PRESETS["default"].splats, iterations=1000))
    factors = [Schedule(config).rate_factor(iteration) for iteration in range(1000)]
    drop = round(DROP_AT * 1000)
    assert set(factors[:drop]) == {1.0}
    assert all(after <= before for before, after in pairwise(factors))
    assert factors[-1] == pytest.approx(DROP_FACTOR)


def test_even_the_shortest_fit_has_a_schedule() -> None:
    for iterations in (1, 2, 7):
        for config in PRESETS.values():
            for name in PERIODIC:
                events(replace(config, splats=replace(config.splats, iterations=iterations)), name)


@pytest.mark.parametrize("iterations", [450, 4500, 45000])
def test_nothing_faint_is_pruned_right_after_a_reset(iterations: int) -> None:
    config = replace(PRESETS["paper"], splats=replace(PRESETS["paper"].splats, iterations=iterations))
    schedule, resets = Schedule(config), events(config, "opacity_reset")
    assert resets
    steps = min(100, round(iterations * 3000 / 45000) // 2)
    for reset in resets:
        recovering = [not schedule.opacities_recovered(iteration) for iteration in range(reset, reset + steps)]
        assert all(recovering)
        assert schedule.opacities_recovered(reset + steps)
