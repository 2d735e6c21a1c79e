"""Joining by hand, and no message lost or used twice."""

from hypothesis import given, settings
from hypothesis import strategies as st

from rayfix_service.adapters.transmissions import Joiner, Transmission


def heard(transmissions: list[Transmission[str]]) -> list[tuple[str, int | None, dict[str, str]]]:
    return [(t.target, t.sequence, t.heard) for t in transmissions]


def test_a_transmission_ends_when_all_stations_have_heard_it():
    joiner: Joiner[str] = Joiner(window=1.0, num_stations=2)
    assert joiner.add("t", "a", 5, "a5", 0.0) == []
    assert joiner.add("t", "b", 6, "b6", 0.1) == []
    assert heard(joiner.add("t", "b", 5, "b5", 0.2)) == [("t", 5, {"a": "a5", "b": "b5"})]
    assert joiner.next_due() == 1.1


def test_a_transmission_ends_with_its_window():
    joiner: Joiner[str] = Joiner(window=1.0)
    joiner.add("t", "a", 5, "a5", 0.0)
    joiner.add("u", "a", 5, "other", 0.5)
    assert joiner.next_due() == 1.0
    assert joiner.due(0.999) == []
    assert heard(joiner.due(1.0)) == [("t", 5, {"a": "a5"})]
    assert heard(joiner.add("u", "b", 9, "late", 1.7)) == [("u", 5, {"a": "other"})]


def test_what_comes_late_is_dropped_for_ten_windows():
    joiner: Joiner[str] = Joiner(window=1.0)
    joiner.add("t", "a", 5, "a5", 0.0)
    joiner.due(1.0)
    assert joiner.add("t", "b", 5, "b5", 1.5) == []
    assert joiner.next_due() is None
    joiner.add("t", "b", 5, "wrapped around", 11.0)
    assert heard(joiner.flush()) == [("t", 5, {"b": "wrapped around"})]


def test_without_sequence_number_the_window_and_the_stations_decide():
    joiner: Joiner[str] = Joiner(window=1.0)
    joiner.add("t", "a", None, "1", 0.0)
    joiner.add("t", "b", None, "2", 0.4)
    assert heard(joiner.add("t", "a", None, "3", 0.5)) == [("t", None, {"a": "1", "b": "2"})]
    assert joiner.next_due() == 1.5
    assert heard(joiner.add("t", "b", None, "4", 2.0)) == [("t", None, {"a": "3"})]
    assert heard(joiner.flush()) == [("t", None, {"b": "4"})]
    assert joiner.flush() == []


Message = tuple[str, str, int]


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from("tu"), st.sampled_from("abc"), st.integers(0, 3)), max_size=30))
def test_in_an_endless_window_every_message_comes_out_once(messages: list[Message]):
    joiner: Joiner[int] = Joiner(window=float("inf"))
    ended = []
    for n, (target, station, sequence) in enumerate(messages):
        ended += joiner.add(target, station, sequence, n, 0.0)
    ended += joiner.flush()
    came = sorted(n for t in ended for n in t.heard.values())
    assert came == list(range(len(messages)))
    for t in ended:
        for station, n in t.heard.items():
            assert messages[n] == (t.target, station, t.sequence)
