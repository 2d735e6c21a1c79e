"""Bluetooth-like streams of angles over a real broker: throughput, latency and loss of positions.

Each locator that receives a packet of a tag publishes its angle; the angles of a packet arrive in random order. Latency
is measured from the arrival of a packet's first angle at the service to the arrival of its position here. A packet that
some locator does not receive waits for the window; its latency is reported separately.
"""

import asyncio
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import aiomqtt
import numpy as np

from benchmarks.common.example_table import open_or_build, table_parser
from benchmarks.common.walks import walk
from rayfix_evaluation.drops.accuracy import drops_at, solver_of
from rayfix_evaluation.drops.simulate import select_path
from rayfix_tables.table import Table

STDEV_DEG = 2.0


def main() -> None:
    parser = table_parser(__doc__, seed=1)
    parser.add_argument("--tags", type=int, default=1)
    parser.add_argument("--rate", type=float, default=40.0, help="packets a second of each tag")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--track", action="store_true")
    options = parser.parse_args()
    program = shutil.which("mosquitto", path="/usr/sbin:/usr/local/sbin:/usr/bin")
    if program is None:
        sys.exit("the broker mosquitto is not installed (Debian: apt-get install mosquitto)")
    with open_or_build(options.table) as table, broker(program) as port:
        packets = make_packets(table, options.tags, options.rate, options.seconds, options.seed)
        command = [sys.executable, "-m", "rayfix", "mqtt", str(table.path), "--broker", f"127.0.0.1:{port}"]
        command += ["--frame", "scene", "--window", "0.1", *(["--track"] if options.track else [])]
        service = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert service.stderr is not None
        try:
            while "reading" not in (line := service.stderr.readline()):
                if not line:
                    sys.exit("the service ended")
            used = cpu_seconds(service.pid)
            asyncio.run(exchange(port, packets, options.tags, options.rate, len(table.site.stations)))
            print(f"the service used {cpu_seconds(service.pid) - used:.1f} s of processor time")
        finally:
            service.terminate()
            service.communicate(timeout=10)


@contextmanager
def broker(program: str) -> Iterator[int]:
    """Run a broker on loopback; yields its port."""
    with tempfile.TemporaryDirectory() as folder:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = int(probe.getsockname()[1])
        config = Path(folder) / "mosquitto.conf"
        lines = [f"listener {port} 127.0.0.1", "user root", "allow_anonymous true", "max_queued_messages 0"]
        config.write_text("\n".join(lines) + "\n", encoding="utf-8")
        process = subprocess.Popen([program, "-c", str(config)], stderr=subprocess.DEVNULL)
        try:
            time.sleep(0.5)
            yield port
        finally:
            process.terminate()
            process.wait(10)


def make_packets(
    table: Table, num_tags: int, rate: float, seconds: float, seed: int
) -> list[tuple[float, list[tuple[str, str]]]]:
    """Draw packets of walking tags: time, and topics with payloads."""
    solver = solver_of(table)
    packets = []
    for tag in range(num_tags):
        rng = np.random.default_rng([seed, tag])
        count = int(rate * seconds)
        # Paths are found twice a second; in between, a tag stands still.
        places = walk(table, rng, count=int(2.0 * seconds) + 1, interval=0.5, speed=1.0)
        drops = drops_at(places, solver, table.site.stations)
        begin = rng.uniform(0.0, 1.0 / rate)
        for n in range(count):
            paths = drops[int(2.0 * n / rate)].paths
            messages = []
            for station in rng.permutation(list(paths)):
                k = select_path(paths[station], "strongest", rng)
                error = STDEV_DEG * rng.standard_normal(2)
                elevation = 90.0 - float(np.degrees(paths[station].zenith[k])) + error[1]
                payload = {
                    "azimuth": -float(np.degrees(paths[station].azimuth[k])) + error[0],
                    "azimuth_stdev": STDEV_DEG,
                    "elevation": float(np.clip(elevation, -90.0, 90.0)),
                    "elevation_stdev": STDEV_DEG,
                    "sequence": n,
                }
                messages.append((f"silabs/aoa/angle/{station}/tag-{tag}", json.dumps(payload)))
            packets.append((begin + n / rate, messages))
    return sorted(packets, key=lambda packet: packet[0])


async def exchange(port: int, packets: list[Any], num_tags: int, rate: float, num_stations: int) -> None:
    """Publish packets at their times, take positions, and print what became of them."""
    latencies: dict[bool, list[float]] = {True: [], False: []}
    async with aiomqtt.Client("127.0.0.1", port=port) as listener, aiomqtt.Client("127.0.0.1", port=port) as sender:
        await listener.subscribe("rayfix/position/#")

        async def listen() -> None:
            async for message in listener.messages:
                now = datetime.now(UTC)
                assert isinstance(message.payload, bytes)
                document = json.loads(message.payload)
                begin = datetime.fromisoformat(document["timestamp"])
                latencies[len(document["measurements"]) == num_stations].append((now - begin).total_seconds())

        listening = asyncio.create_task(listen())
        start = time.perf_counter()
        behind = 0.0
        for moment, messages in packets:
            wait = start + moment - time.perf_counter()
            behind = max(behind, -wait)
            if wait > 0.0:
                await asyncio.sleep(wait)
            for topic, payload in messages:
                await sender.publish(topic, payload)
        seconds = time.perf_counter() - start
        before = -1
        while before != (received := sum(map(len, latencies.values()))):
            before = received
            await asyncio.sleep(1.0)
        listening.cancel()
    count = sum(len(messages) for _, messages in packets)
    print(
        f"{num_tags} tags at {rate:g} Hz: {count} angles and {len(packets)} packets in {seconds:.1f} s "
        f"({count / seconds:.0f} angles a second), sender at most {1e3 * behind:.0f} ms behind"
    )
    print(f"{received} positions, {len(packets) - received} packets without")
    for complete, name in ((True, "heard by all"), (False, "others")):
        if values := latencies[complete]:
            half, most, worst = 1e3 * np.quantile(values, (0.5, 0.99, 1.0))
            print(
                f"{len(values)} packets {name}: latency {half:.1f} ms (median), {most:.1f} ms (99 %), {worst:.1f} ms "
                "(worst)"
            )


def cpu_seconds(pid: int) -> float:
    """Processor time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100.0


if __name__ == "__main__":
    main()
