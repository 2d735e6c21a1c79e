"""The store of targets, and reports whose times do not fit."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rayfix_service.fusion.posterior.fused import Fused
from rayfix_service.fusion.product.beam import Hypotheses
from rayfix_service.tracking.estimate import largest_group
from rayfix_service.tracking.settings import TrackingSettings
from rayfix_service.tracking.track import TrackedPosition
from rayfix_service.tracking.tracker import Tracker
from rayfix_tables.errors import ReportError
from rayfix_tables.scene import Scene

Send = Callable[..., TrackedPosition | None]


class Clock:
    """The service's clock, set by hand."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        """Tell the time, s."""
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def tracker(open_scene: Scene, clock: Clock) -> Tracker:
    return Tracker(open_scene, TrackingSettings(max_targets=3, max_age=60.0), clock=clock)


@pytest.fixture
def send(tracker: Tracker, make_hypotheses: Callable[..., Hypotheses], make_fused: Callable[..., Fused]) -> Send:
    """Send a report of places, by time in seconds and target."""

    def send_report(
        seconds: float, places: Sequence[Sequence[float]] | None, target: str = "t", **how: object
    ) -> TrackedPosition | None:
        moment = datetime(2026, 1, 31, 10, tzinfo=UTC) + timedelta(seconds=seconds)
        hypotheses = None if places is None else make_hypotheses(places, **how)
        return tracker.follow(make_fused(hypotheses, target=target, timestamp=moment.isoformat()))

    return send_report


def test_a_walk_gives_position_and_velocity(send: Send):
    rng = np.random.default_rng(1)
    for n in range(40):
        truth = np.array([0.25 * n, -0.1 * n, 1.0])
        track = send(0.25 * n, [(truth + 0.1 * rng.standard_normal(3)).tolist()])
        assert track is not None
        assert track.state == ("updated" if n else "started")
        assert track.num_reports == n + 1
    assert np.linalg.norm(track.estimate.position - truth) < 0.2
    np.testing.assert_allclose(track.estimate.velocity, [1.0, -0.4, 0.0], atol=0.4)
    assert track.estimate.probability == pytest.approx(1.0, abs=1e-12)
    # Better than one report, and not by more than it can be.
    assert 0.02 < np.sqrt(np.trace(track.estimate.covariance) / 3) < 0.1
    away = track.estimate.velocity - [1.0, -0.4, 0.0]
    assert away @ np.linalg.solve(track.estimate.velocity_covariance, away) < 16.3  # 99.9 % of chi2 with 3 degrees


def test_a_track_tells_rivals_of_a_report_apart(send: Send):
    near, far = [0.1, 0.0, 1.0], [8.0, 0.0, 1.0]
    alone = send(0.2, [near, far], target="unknown", probabilities=[0.3, 0.7])
    assert alone is not None
    assert alone.estimate.position[0] > 7.0
    assert alone.estimate.probability == pytest.approx(0.7, abs=0.01)
    send(0.0, [[0.0, 0.0, 1.0]])
    track = send(0.2, [near, far], probabilities=[0.3, 0.7])
    assert track is not None
    assert track.estimate.probability > 0.999
    assert abs(track.estimate.position[0] - 0.1) < 0.2


def test_both_rivals_live_until_a_report_tells(send: Send):
    """The target walks along x or along y = 6; only the last report knows."""
    for n in range(5):
        track = send(0.5 * n, [[0.4 * n, 0.0, 1.0], [0.4 * n, 6.0, 1.0]], probabilities=[0.6, 0.4])
    assert track is not None
    # Five reports with odds of 3 to 2 each.
    assert track.estimate.probability == pytest.approx(1 / (1 + (2 / 3) ** 5), abs=0.1)
    track = send(2.5, [[2.0, 6.0, 1.0]])
    assert track is not None
    assert track.state == "updated"
    assert track.estimate.position[1] > 5.5
    assert track.estimate.velocity[0] == pytest.approx(0.8, abs=0.5)


def test_a_target_that_is_elsewhere_starts_anew(send: Send):
    send(0.0, [[0.0, 0.0, 1.0]])
    send(0.5, [[0.0, 0.0, 1.0]])
    states, tracks = [], []
    for n in range(3):
        track = send(1.0 + 0.2 * n, [[20.0, 5.0, 1.0]])
        assert track is not None
        states.append(track.state)
        tracks.append(track)
    assert "restarted" in states
    assert np.linalg.norm(tracks[-1].estimate.position - [20.0, 5.0, 1.0]) < 0.3
    assert tracks[-1].num_reports < 4


def test_reports_repeated_or_overtaken_change_nothing(send: Send):
    send(0.0, [[0.0, 0.0, 1.0]])
    last = send(1.0, [[0.5, 0.0, 1.0]])
    assert last is not None
    for seconds in (1.0, 0.4, 0.999999):
        late = send(seconds, [[-3.0, 0.0, 1.0]])
        assert late is not None
        assert late.state == "late"
        assert late.estimate is last.estimate
        assert late.timestamp == last.timestamp
    following = send(1.2, [[0.6, 0.0, 1.0]])
    assert following is not None
    assert (following.state, following.num_reports) == ("updated", 3)


def test_a_long_gap_starts_anew_and_a_short_one_goes_on(send: Send):
    for n in range(5):
        send(0.5 * n, [[0.5 * n, 0.0, 1.0]])
    on = send(5.0, [[5.0, 0.0, 1.0]])
    assert on is not None
    assert (on.state, on.num_reports) == ("updated", 6)
    anew = send(10.5, [[5.0, 0.0, 1.0]])
    assert anew is not None
    assert (anew.state, anew.num_reports) == ("restarted", 1)


def test_a_clock_set_back_costs_one_report_and_a_stray_one_nothing(send: Send):
    send(100.0, [[0.0, 0.0, 1.0]])
    send(100.5, [[0.0, 0.0, 1.0]])
    states = [send(s, [[0.0, 0.0, 1.0]]) for s in (0.0, 101.0, 0.5, 101.5, 1.0, 1.5)]
    assert [track.state for track in states if track] == ["late", "updated", "late", "updated", "late", "restarted"]


def test_one_report_from_the_future_does_not_lose_the_target(send: Send):
    send(0.0, [[0.0, 0.0, 1.0]])
    states = [send(s, [[0.0, 0.0, 1.0]]) for s in (90_000.0, 0.5, 1.0, 1.5)]
    assert [track.state for track in states if track] == ["restarted", "late", "restarted", "updated"]


def test_a_report_that_says_nothing_moves_the_track_on(send: Send):
    assert send(0.0, None) is None
    for n in range(8):
        send(0.25 * n, [[0.25 * n, 0.0, 1.0]])
    before = send(2.0, [[2.0, 0.0, 1.0]])
    blind = send(3.0, None)
    assert before is not None
    assert blind is not None
    assert (blind.state, blind.num_reports) == ("predicted", 9)
    assert blind.estimate.position[0] == pytest.approx(3.0, abs=0.5)
    assert np.trace(blind.estimate.covariance) > 4 * np.trace(before.estimate.covariance)


def test_targets_not_heard_of_are_forgotten(send: Send, tracker: Tracker, clock: Clock):
    for n, name in enumerate("abc"):
        clock.now = float(n)
        send(0.0, [[0.0, 0.0, 1.0]], target=name)
    clock.now = 10.0
    assert send(0.5, [[0.0, 0.0, 1.0]], target="a").num_reports == 2
    send(0.0, [[0.0, 0.0, 1.0]], target="d")  # the fourth: b has not been heard of for longest
    assert tracker.num_targets == 3
    assert send(0.5, [[0.0, 0.0, 1.0]], target="c").num_reports == 2
    assert send(0.5, [[0.0, 0.0, 1.0]], target="b").num_reports == 1
    clock.now = 69.9
    send(1.0, [[0.0, 0.0, 1.0]], target="c")
    clock.now = 70.1  # a is gone since c came, d and b have just passed 60 s
    send(1.5, [[0.0, 0.0, 1.0]], target="c")
    assert tracker.num_targets == 1


def test_tracks_depend_on_nothing_but_their_reports(
    open_scene: Scene, make_hypotheses: Callable[..., Hypotheses], make_fused: Callable[..., Fused]
):
    def walk(*others: str) -> TrackedPosition | None:
        tracker, last = Tracker(open_scene), None
        for n in range(5):
            hypotheses = make_hypotheses([[0.1 * n, 0.0, 1.0], [0.1 * n, 1.0, 1.0]])
            for name in (*others, "t"):
                last = tracker.follow(make_fused(hypotheses, target=name, timestamp=f"2026-01-31T10:00:0{n}Z"))
        return last

    alone, among = walk(), walk("u", "v")
    assert alone is not None
    assert among is not None
    np.testing.assert_array_equal(alone.estimate.position, among.estimate.position)


@pytest.mark.parametrize(
    ("target", "timestamp", "key"), [(None, "2026-01-31T10:00:00Z", "target_id"), ("t", None, "timestamp")]
)
def test_without_name_or_time_nothing_can_be_followed(
    tracker: Tracker,
    make_hypotheses: Callable[..., Hypotheses],
    make_fused: Callable[..., Fused],
    target: str | None,
    timestamp: str | None,
    key: str,
):
    with pytest.raises(ReportError, match=f"{key} is missing") as found:
        tracker.follow(make_fused(make_hypotheses([[0.0, 0.0, 1.0]]), target=target, timestamp=timestamp))
    assert found.value.path == (key,)


def test_the_largest_group_hangs_together():
    rng = np.random.default_rng(1)
    chain = np.linspace(0, 6, 40)[:, None] * [1.0, 0.5, 0.0]  # points 0.17 m apart, in cells of 0.5 m
    heap = rng.normal(scale=0.05, size=(30, 3)) + np.array([20.0, 0.0, 0.0])
    points = np.concatenate([chain, heap])
    shuffle = rng.permutation(len(points))
    np.testing.assert_array_equal(largest_group(points[shuffle]), shuffle < 40)


PLACES = st.tuples(*[st.floats(-29.0, 29.0)] * 3).map(list)


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(
            st.floats(-20.0, 20.0),
            st.sampled_from(["a", "b", "c", "d"]),
            st.none() | st.lists(PLACES, min_size=1, max_size=4),
            st.sampled_from([0.003, 0.3, 10.0]),
            st.sampled_from([-300.0, -5.0, 5.0]),
        ),
        min_size=1,
        max_size=12,
    )
)
def test_whatever_comes_in_whatever_order_a_track_is_sound(
    sheet_scene: Scene,
    make_hypotheses: Callable[..., Hypotheses],
    make_fused: Callable[..., Fused],
    reports: list[tuple[float, str, list[list[float]] | None, float, float]],
):
    tracker = Tracker(sheet_scene, TrackingSettings(max_targets=3, num_particles=64))
    latest: dict[str, datetime] = {}
    for seconds, target, places, stdev, log_all_outlier in reports:
        moment = datetime(2026, 1, 31, 10, tzinfo=UTC) + timedelta(seconds=seconds)
        hypotheses = None if places is None else make_hypotheses(places, stdev, None, log_all_outlier)
        track = tracker.follow(make_fused(hypotheses, target=target, timestamp=moment.isoformat()))
        assert tracker.num_targets <= 3
        if track is None:
            assert places is None or target not in latest
            continue
        told = datetime.fromisoformat(track.timestamp)
        if track.state in ("updated", "predicted"):
            assert told == moment > latest[target]
        elif track.state == "late":
            assert told == latest[target] >= moment
        latest[target] = told
        found = track.estimate
        assert np.isfinite(found.position).all()
        assert np.abs(found.position).max() <= 30.0
        assert np.linalg.eigvalsh(found.covariance).min() > 0.0
        assert np.linalg.eigvalsh(found.velocity_covariance).min() > 0.0
        assert 0.0 < found.probability <= 1.0
