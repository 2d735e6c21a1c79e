"""Reading takes time in proportion to the message at most, and little memory, whatever the message is made of."""

import json
import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import thread_time
from typing import Any

import pytest

from rayfix_service.adapters.formats import write
from rayfix_service.adapters.nrppa import parse_nrppa
from rayfix_service.adapters.silabs import parse_silabs
from rayfix_service.adapters.silabs_stream import SilabsStream
from rayfix_service.adapters.transmissions import Joiner
from rayfix_service.adapters.ublox import parse_ublox
from rayfix_service.batch import locate_batch
from rayfix_service.fusion.posterior.fix import Fix, Outcome
from rayfix_service.locator import Locator
from rayfix_service.wire import FieldProblem, InvalidReportError, fix_to_document, parse_report, problems_of
from rayfix_service.wire.batches import split_batch
from rayfix_service.wire.limits import USUAL_LIMITS, MessageLimits, has_more_values
from rayfix_tables.errors import ReportError
from rayfix_tables.site import SiteInfo, Station
from rayfix_tables.table import Table
from tests.support.running.thread_seconds import fastest_thread_seconds

MEBIBYTE = 1 << 20

Read = Callable[[bytes], object]
Make = Callable[[int], bytes]


def dumped(document: Any) -> bytes:
    return json.dumps(document, separators=(",", ":")).encode()


def lines(n: int, tag: Callable[[int], str], anchor: Callable[[int], str], sequence: Callable[[int], str]) -> bytes:
    made = (f'+UUDF:{tag(k)},-53,15,-6,0,37,"{anchor(k)}","",{k}{sequence(k)}\n' for k in range(n))
    return "".join(made).encode()


def aoa(**more: Any) -> dict[str, Any]:
    return {"type": "aoa", "station_id": "bs1", "azimuth_deg": 10.0, "azimuth_stdev_deg": 1.0, **more}


def nrppa(*items: dict[str, Any], **more: Any) -> bytes:
    """Write a message of items, 64 to a TRP."""
    trps = [{"tRP-ID": k + 1, "measurementResult": items[k : k + 64]} for k in range(0, len(items), 64)]
    return dumped({"TRP-MeasurementResponseList": trps, **more})


def nrppa_angle(k: int) -> dict[str, Any]:
    turned = {"alpha": k % 3600, "beta": 5, "gamma": 7}
    angle = {"azimuthAoA": k % 3600, "zenithAoA": 900, "lCS-to-GCS-Translation": turned}
    return {"measuredResultsValue": {"uL-AngleOfArrival": angle}}


NO_AZIMUTH = {"measuredResultsValue": {"MultipleULAoA": {"multipleULAoA": [{"ul-ZoA": {"zenithAoA": 900}}] * 8}}}


def locator(k: int) -> dict[str, Any]:
    return {"locator_id": f"l{k}", "azimuth": 1.0 + k, "azimuth_stdev": 1, "elevation": 2, "elevation_stdev": 1}


def unknown(n: int) -> dict[str, int]:
    return {f"key{k}": k for k in range(n)}


UBLOX: dict[str, Make] = {
    "one transmission": lambda n: lines(n, lambda k: "t", lambda k: f"a{k}", lambda k: ",7"),
    "all different": lambda n: lines(n, lambda k: f"t{k}", lambda k: f"a{k}", lambda k: f",{k}"),
    "all the same": lambda n: lines(n, lambda k: "t", lambda k: "a", lambda k: ",7"),
    "all the same, without sequence": lambda n: lines(n, lambda k: "t", lambda k: "a", lambda k: ""),
    "interleaved": lambda n: lines(n, lambda k: f"t{k % 50}", lambda k: f"a{k // 50}", lambda k: f",{k % 7}"),
    "few reports of many": lambda n: lines(n, lambda k: f"t{k % 100}", lambda k: f"a{k // 100}", lambda k: ",1"),
    "other lines": lambda n: b"AT+OK\n" * n,
    "empty lines": lambda n: b"\n" * (20 * n),
    "one long line": lambda n: b"+UUDF:" + b'"",' * n,
}

JSON_FORMATS: dict[str, tuple[Read, dict[str, Make]]] = {
    "native": (
        parse_report,
        {
            "measurements": lambda n: dumped({"measurements": [aoa(azimuth_deg=k / 10) for k in range(n // 8)]}),
            "too many": lambda n: dumped({"measurements": [aoa()] * n}),
            "unknown keys": lambda n: dumped(unknown(n)),
            "unknown keys in each": lambda n: dumped({"measurements": [aoa(**unknown(n // 64))] * 64}),
            "wrong in each": lambda n: dumped({"measurements": [aoa(azimuth_deg="x", zenith_deg=[])] * (n // 8)}),
            "no objects": lambda n: dumped({"measurements": [1] * n}),
            "brackets": lambda n: b'{"measurements":' + b"[" * n + b"]" * n + b"}",
            "unfinished": lambda n: b'{"measurements":[' * n,
            "escapes": lambda n: b'{"target_id":"' + b'\\"' * n,
            "quotes": lambda n: b'""' * n,
            "spaces": lambda n: b" " * (8 * n) + b"{}",
            "a long number": lambda n: b'{"confidence":' + b"9" * n + b"}",
        },
    ),
    "nrppa": (
        parse_nrppa,
        {
            "angles": lambda n: nrppa(*(nrppa_angle(k) for k in range(n // 8))),
            "not used": lambda n: nrppa(*[NO_AZIMUTH] * (n // 64)),
            "wrong in each": lambda n: nrppa(*[{"measuredResultsValue": {}, "measurementQuality": {}}] * (n // 8)),
            "no objects": lambda n: nrppa(*[{}] * n),
            "unknown keys": lambda n: dumped(unknown(n)),
            "stations": lambda n: nrppa(nrppa_angle(1), stations=unknown(n)),
            "not read": lambda n: nrppa(nrppa_angle(1) | {"timeStamp": [[k] for k in range(n)]}),
            "round trips": lambda n: nrppa(
                *[{"measuredResultsValue": {"gNB-RxTxTimeDiff": {"rxTxTimeDiff": {"k0": 1000000}}}}] * (n // 32),
                ue_rx_tx=[{"tRP-ID": 1, "nr-UE-RxTxTimeDiff-r16": {"k0-r16": 1000000}}] * min(n // 32, 64),
            ),
        },
    ),
    "silabs": (
        parse_silabs,
        {
            "angles": lambda n: dumped({"angles": [locator(k) for k in range(n // 8)]}),
            "keys passed over": lambda n: dumped({"angles": [locator(1) | {"samples": [1] * n}]}),
            "unknown keys": lambda n: dumped(unknown(n)),
            "wrong in each": lambda n: dumped({"angles": [{"azimuth": "x", "elevation": 1}] * (n // 8)}),
            "stations": lambda n: dumped({"angles": [locator(1)], "stations": unknown(n)}),
        },
    ),
    "batch": (
        split_batch,
        {
            "reports": lambda n: dumped({"reports": [{"measurements": [aoa()]}] * (n // 8)}),
            "long reports": lambda n: dumped({"reports": [{"measurements": [aoa()] * (n // 8)}] * 4}),
            "unknown keys": lambda n: dumped(unknown(n)),
            "brackets": lambda n: b'{"reports":[' + b"[" * n,
            "quotes": lambda n: b'{"reports":[' + b'""' * n,
            "escaped quotes": lambda n: b'{"reports":["' + b'\\"' * n,
            "unfinished strings": lambda n: b'{"reports":[' + b'"\\' * n,
            "empty": lambda n: b'{"reports":[' + b"," * n,
            "twice": lambda n: b'{"reports":[],' * n,
        },
    ),
}

SITE = SiteInfo(
    name="hall",
    north=0.0,
    max_path_length=60.0,
    document={},
    stations=tuple(
        Station(id=f"bs{k}", position=(0.0, 0.0, 2.0), orientation=(0.0, 0.0, 0.0), field_of_view=6.3)
        for k in range(40)
    ),
)

PAYLOAD = dumped({"azimuth": 1, "azimuth_stdev": 1, "sequence": 1})


def stream(topic: Callable[[int], str], payload: Callable[[int], bytes], step: float) -> Callable[[int], None]:
    """Return what takes so many messages from a broker."""

    def take(n: int) -> None:
        taker = SilabsStream(SITE, window=0.5)
        for k in range(n):
            taker.receive(topic(k), payload(k), k * step)
        taker.due(n * step + 1.0)

    return take


def numbered(k: int) -> bytes:
    return dumped({"azimuth": 1, "azimuth_stdev": 1, "sequence": k})


STREAMS: dict[str, Callable[[int], None]] = {
    "one packet": stream(lambda k: f"a/bs{k % 40}/t", lambda k: PAYLOAD, 0.0),
    "a packet each": stream(lambda k: f"a/bs1/t{k}", numbered, 0.0),
    "packets one after the other": stream(lambda k: f"a/bs{k % 3}/t{k % 7}", lambda k: numbered(k // 3), 0.01),
    "strangers": stream(lambda k: f"a/other{k}/t", lambda k: PAYLOAD, 0.0),
    "not JSON": stream(lambda k: f"a/bs{k % 40}/t", lambda k: b"{" * 100, 0.0),
    "the same sequence": stream(lambda k: "a/bs1/t", lambda k: dumped({"azimuth": k % 9, "azimuth_stdev": 1}), 0.0),
}


def joined(messages: int, *, window: float, step: float, sequences: int) -> None:
    joiner: Joiner[int] = Joiner(window=window)
    for k in range(messages):
        joiner.add("t", f"a{k}", k % sequences, k, k * step)
    joiner.flush()


CASES: list[Any] = [
    *(
        pytest.param(lambda n, make=make: partial(attempt, parse_ublox, make(n)), 1000, id=f"ublox: {name}")
        for name, make in UBLOX.items()
    ),
    *(
        pytest.param(lambda n, read=read, make=make: partial(attempt, read, make(n)), 2000, id=f"{form}: {name}")
        for form, (read, makes) in JSON_FORMATS.items()
        for name, make in makes.items()
    ),
    *(pytest.param(lambda n, take=take: partial(take, n), 250, id=f"stream: {name}") for name, take in STREAMS.items()),
    pytest.param(lambda n: partial(joined, n, window=1e9, step=0.0, sequences=10**9), 1000, id="joining: nothing ends"),
    pytest.param(
        lambda n: partial(joined, n, window=1.0, step=0.01, sequences=10**9), 1000, id="joining: windows pass"
    ),
    pytest.param(lambda n: partial(joined, n, window=1.0, step=0.3, sequences=5), 1000, id="joining: all late"),
    pytest.param(
        lambda n: partial(attempt, lambda _: write(fix_of(n), "omlox", SITE, compute_seconds=0.0), b""),
        1000,
        id="omlox out",
    ),
    pytest.param(lambda n: partial(fix_to_document, fix_of(n), 0.0), 1000, id="native out"),
]


def fix_of(n: int) -> Fix:
    """Make a fix without a position, of so many measurements."""
    outcomes = tuple(Outcome(used=False, reason="no ray of bs1 comes from there") for _ in range(n))
    return Fix(status="insufficient", candidates=(), outcomes=outcomes, log_evidence=0.0, table_id="id")


def attempt(read: Read, message: bytes) -> object:
    """Read a message; returns what came of it or the refusal."""
    try:
        return read(message)
    except ReportError as error:
        return error


@pytest.mark.parametrize(("case", "size"), CASES)
def test_eight_times_as_much_takes_at_most_twelve_times_as_long(case: Callable[[int], Callable[[], object]], size: int):
    """The time for u-blox lines grew with the square and cube of their number, that for other messages with errors."""
    small, large = case(size), case(8 * size)
    for runs in (3, 5, 9, 15):
        # What takes less than a millisecond takes no time that could be compared on a busy machine.
        if fastest_thread_seconds(large, runs) <= 12.0 * max(fastest_thread_seconds(small, runs), 1e-3):
            return
    pytest.fail(f"{fastest_thread_seconds(small, 9):.2e} s became {fastest_thread_seconds(large, 9):.2e} s")


def filling(make: Make, limit: int = MEBIBYTE) -> bytes:
    """Make the longest message of a kind within a limit, to a factor of two."""
    n = 64
    while len(make(2 * n)) <= limit:
        n *= 2
    return make(n)


LONGEST: list[Any] = [
    *(pytest.param(parse_ublox, make, id=f"ublox: {name}") for name, make in UBLOX.items()),
    *(
        pytest.param(read, make, id=f"{form}: {name}")
        for form, (read, makes) in JSON_FORMATS.items()
        for name, make in makes.items()
        if len(make(4096)) > len(make(64))
    ),
]


@pytest.mark.parametrize(("read", "make"), LONGEST)
def test_a_message_as_long_as_a_body_may_be_is_read_or_refused_at_once(read: Read, make: Make):
    """A mebibyte of lines took more than 300 s, one of NRPPa 15 s, and an answer had 30,000 errors."""
    message = filling(make)
    assert len(message) > MEBIBYTE // 4
    begin = thread_time()
    outcome = attempt(read, message)
    assert thread_time() - begin < 3.0
    if isinstance(outcome, ReportError):
        assert len(problems_of(outcome)) <= USUAL_LIMITS.listed_problems
        assert len(str(outcome)) < 2000


def test_the_errors_of_a_report_are_listed_up_to_a_limit_and_counted():
    """All of many thousand errors were made ready before most of them were thrown away uncounted."""
    with pytest.raises(InvalidReportError) as refused:
        parse_report({"measurements": [aoa(zenith_deg=[])] * 100 + [aoa(**unknown(100))], "extra": 1})
    error = refused.value
    assert len(error.problems) == USUAL_LIMITS.listed_problems
    assert error.more == 100 + 100 + 1 - USUAL_LIMITS.listed_problems
    assert str(error).endswith("(and 200 more)")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.problems, again.more, again.path) == (str(error), error.problems, error.more, error.path)


def test_measurements_that_are_not_used_are_listed_up_to_a_limit_and_counted():
    """One answer listed 30,000 angles that no fix can use."""
    with pytest.raises(InvalidReportError, match=r"\(and 127 more\)") as refused:
        parse_nrppa(nrppa(*[NO_AZIMUTH] * 16))
    assert len(refused.value.problems) == USUAL_LIMITS.listed_problems
    assert refused.value.more == 128 - USUAL_LIMITS.listed_problems


def test_counts_are_looked_at_first():
    """Limits were found exceeded after all else had been validated or converted."""
    with pytest.raises(InvalidReportError, match=f"has more than {USUAL_LIMITS.results} measurements; give at most"):
        parse_nrppa(nrppa(*[{}] * (USUAL_LIMITS.results + 1)))
    with pytest.raises(InvalidReportError, match="stations has 1025 names; give at most 1024"):
        parse_silabs(dumped({"angles": [], "stations": unknown(1025)}))
    with pytest.raises(InvalidReportError, match="the report has more than 5000 values; give at most 256 measurements"):
        parse_report(dumped({"measurements": [aoa(**unknown(100))] * 60}))
    with pytest.raises(InvalidReportError, match="reports is an array of more than 1000"):
        split_batch(dumped({"reports": [{}] * 1001}))
    with pytest.raises(InvalidReportError, match="ue_rx_tx makes more than 2048 measurements"):
        parse_nrppa(JSON_FORMATS["nrppa"][1]["round trips"](32 * 64))


def test_what_may_be_sent_is_not_refused_for_its_length():
    """The limits leave room for all that a report can hold, names of the longest and commas included."""
    name = "a,[{" * 32
    full = aoa(
        station_id=name,
        zenith_deg=80.0,
        zenith_stdev_deg=1.0,
        correlation=0.1,
        frame="scene",
        error_model="heavy_tailed",
        tail_share=0.1,
        tail_scale=3.0,
        los_probability=0.5,
    )
    full = {json.dumps(key)[1:-1]: value for key, value in full.items()}
    body = dumped({"target_id": name * 2, "height": {"z_m": 1, "stdev_m": 1}, "measurements": [full] * 256})
    assert len(parse_report(body).measurements) == 256
    assert [parse_report(one).target_id for one in split_batch(b'{"reports":[' + body + b" , " + body + b"]}")] == [
        name * 2
    ] * 2


def test_values_are_counted_outside_of_strings():
    assert not has_more_values(dumped({"a": ",[{" * 100, 'b"': ['\\",', "\\\\"]}), 4)
    assert has_more_values(dumped({"a": 1, "b": [1, 2, 3]}), 4)
    assert not has_more_values(dumped({"a": 1, "b": [1, 2, 3]}), 5)


@pytest.mark.parametrize(
    ("body", "texts"),
    [
        (b' {"reports" : [ ] } ', []),
        (b'{"reports":[1, "a,]}" ,{"b":[{}]},[]]}', [b"1", b' "a,]}" ', b'{"b":[{}]}', b"[]"]),
        (b'{"reports":["\\\\","\\""]}', [b'"\\\\"', b'"\\""']),
        (b'{"\\u0072eports":[{"a":1}]}', [b'{"a":1}']),
    ],
)
def test_a_batch_is_taken_apart(body: bytes, texts: list[bytes]):
    assert split_batch(body) == texts


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b'{"reports":[{}', "is not JSON"),
        (b'{"reports":[' + b"[" * 300 + b"]" * 300 + b"]}", "is nested more than"),
        (b'{"reports":[{}}', "is not JSON"),
        (b'{"reports":[{}]', "is not JSON"),
        (b'{"reports":[{}],}', "is not JSON"),
        (b'{"reports":[]}]', "is not JSON"),
        (b'{"reports":[],"reports":[1]}', "reports is there twice"),
        (b'{"reports":[],"more":[1]}', "more is an unknown key"),
        (b'{"reports":[]' + b" " * (1 << 17) + b"}", "bytes after its reports"),
        (b'{"a":"' + b"b" * (1 << 17) + b'","reports":[]}', "does not begin with its reports"),
        (b"[]", "no JSON object"),
    ],
)
def test_what_is_no_batch_is_refused(body: bytes, words: str):
    with pytest.raises(ReportError, match=words):
        split_batch(body)


def resident_peak() -> int:
    """Most memory that this process has had since :func:`forget_peak`, bytes."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    raise AssertionError("the kernel tells no peak")


def forget_peak() -> int:
    """Begin anew to look for the most memory; returns what there is, bytes."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return resident_peak()


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="needs Linux's figures of memory")
@pytest.mark.parametrize(
    "body",
    [
        pytest.param(b'{"reports":[{' + b",".join(b'"k%d":1' % k for k in range(1_000_000)) + b"}]}", id="one report"),
        pytest.param(dumped({"reports": [unknown(1000)] * 1000}), id="all reports"),
        pytest.param(dumped(unknown(1_000_000)), id="the batch"),
        pytest.param(b'{"reports":[' + b"[" * 13_000_000, id="brackets"),
    ],
)
def test_a_batch_of_unknown_keys_takes_no_more_memory_than_its_text(body: bytes):
    """13 MB of unknown keys took 1.6 GB."""
    assert len(body) > 11_000_000
    before = forget_peak()
    found: list[tuple[FieldProblem, ...]] = []
    try:
        for text in split_batch(body):
            try:
                parse_report(text, limits=MessageLimits(listed_problems=1))
            except ReportError as error:
                found.append(problems_of(error))
    except ReportError as error:
        found.append(problems_of(error))
    assert resident_peak() - before < 100_000_000
    assert found
    assert all(len(problems) == 1 for problems in found)


def test_errors_of_a_batch_keep_no_reports(hall_table_path: Path):
    """Each error of the Python interface kept the report that it is of in memory, by the way that it came."""
    (error,) = locate_batch(
        Locator(Table.open(hall_table_path)), [{"measurements": [aoa(station_id="a" * 200)]}], jobs=1
    )
    assert isinstance(error, ReportError)
    assert error.__traceback__ is None
    assert error.__context__ is None


def test_errors_of_a_batch_come_from_other_processes(hall_table_path: Path):
    """An error with fields could not be handed from one process to another, which cost the whole batch."""
    reports = [{"measurements": [aoa()]}] * 64 + [{"measurements": []}] * 64
    answers = locate_batch(Locator(Table.open(hall_table_path)), reports, jobs=2)
    assert [isinstance(answer, InvalidReportError) for answer in answers] == [False] * 64 + [True] * 64
