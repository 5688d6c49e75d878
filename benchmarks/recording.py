# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Losses and cost of the recorder at full rate, and losses after a kill.

The recorder runs as it is installed, and other processes publish raw messages of 156 bytes, each
with its number in it, at the requested rate. Losses are counted twice: by the recorder itself, and
by comparing every message in the bag with the one that was sent. In the last part the recorder is
killed, and the content of its file is compared in the same way.
"""

import argparse
import contextlib
import re
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from common import at_least, claim_domain, join_ros, parser, show

_NAMES = [f"joint_{k}" for k in range(3)]
_SIZE = 156
_BURST_PERIOD = 0.001
_PUBLISHERS = 2
_SURVIVAL = 5.0


class _Load(NamedTuple):
    name: str
    topics: int
    rate: float


_LOADS = (_Load("10 topics at 1 kHz", 10, 1000.0), _Load("1 topic at 10 kHz", 1, 10_000.0))


def _encoder() -> Callable[[int, int], bytes]:
    """Return a function that makes message number n of topic k; no two have the same bytes."""
    from tsobs_ros.bag.joint_states import JointStateEncoder

    encode = JointStateEncoder(_NAMES)

    def message(topic: int, number: int) -> bytes:
        return encode(number, [float(topic)] * 3, [0.5] * 3, [-1.5] * 3)

    assert len(message(0, 0)) == _SIZE, f"messages are of {len(message(0, 0))} bytes"
    return message


def _publish(options: argparse.Namespace) -> None:
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState

    rclpy = join_ros()
    node, encode = rclpy.create_node(f"source_{options.first}"), _encoder()
    topics = range(options.first, options.first + options.topics)
    publishers = [
        (k, node.create_publisher(JointState, f"load_{k}", QoSProfile(depth=5000))) for k in topics
    ]
    while any(p.get_subscription_count() == 0 for _, p in publishers):
        time.sleep(0.05)
    print("started", flush=True)
    period = max(_BURST_PERIOD, 1.0 / options.rate)
    burst, due, number = round(options.rate * period), time.monotonic(), 0
    while number < options.rate * options.seconds:
        for _ in range(burst):
            number += 1
            for topic, publisher in publishers:
                publisher.publish(encode(topic, number))
        due += period
        time.sleep(max(0.0, due - time.monotonic()))
    for _, publisher in publishers:
        publisher.wait_for_all_acked()
    print(f"done {number} in {time.monotonic() - due + options.seconds:.3f} s", flush=True)
    node.destroy_node()
    rclpy.shutdown()


def _start(load: _Load, seconds: float, folder: Path, domain: int) -> tuple[Any, list[Any], Path]:
    """Return the recorder, the publishers and the bag, once messages flow."""
    from node_processes import Process, executable

    bag = folder / f"bag_{len(list(folder.iterdir()))}"
    topics = [f"load_{k}" for k in range(load.topics)]
    recorder = executable("recorder", {"output": str(bag), "topics": topics}, folder, domain)
    recorder.wait_for("recording to")
    share = -(-load.topics // _PUBLISHERS)
    sources = []
    for first in range(0, load.topics, share):
        what = {"first": first, "topics": min(share, load.topics - first)}
        what |= {"rate": load.rate, "seconds": seconds}
        arguments = [word for key, value in what.items() for word in (f"--{key}", str(value))]
        command = [__file__, "--publish", *arguments]
        sources.append(Process(f"source {first}", command, folder, domain))
    for source in sources:
        source.wait_for("started")
    return recorder, sources, bag


def _measure(load: _Load, seconds: float, folder: Path, domain: int) -> dict[str, Any]:
    from tsobs_ros.bag import BagReader

    recorder, sources, bag = _start(load, seconds, folder, domain)
    begun, used = time.monotonic(), recorder.cpu_seconds()
    time.sleep(seconds)
    used, took = recorder.cpu_seconds() - used, time.monotonic() - begun
    for source in sources:
        source.wait_for("done")
        source.stop()
    if (code := recorder.stop()) != 0:
        sys.exit(f"the recorder ended with {code}:\n{recorder.output}")
    closing = re.search(r": (\d+) messages of \d+ topics, (\d+) lost", recorder.output)
    assert closing is not None, recorder.output
    stored = [(m.topic, m.data) for m in BagReader(bag).messages()]
    sent = load.topics * round(load.rate * seconds)
    return {
        "load": load.name,
        "sent": sent,
        "stored": len(stored),
        "lost_by_count": int(closing[2]),
        "lost_by_content": sent - _intact(stored, round(load.rate * seconds)),
        "cpu_percent": round(100.0 * used / took, 1),
        "bytes_a_message": round(sum(f.stat().st_size for f in bag.glob("*.mcap")) / sent, 1),
    }


def _intact(stored: list[tuple[str, bytes]], last: int) -> int:
    """Return how many messages up to the number `last` are stored in order and unchanged."""
    encode, numbers = _encoder(), defaultdict(int)
    for topic, data in stored:
        expected = numbers[topic] + 1
        if expected <= last and data == encode(int(topic.rpartition("_")[2]), expected):
            numbers[topic] = expected
    return sum(numbers.values())


def _killed(seconds: float, folder: Path, domain: int) -> dict[str, Any]:
    """Kill the recorder and return the content of its file."""
    recorder, sources, bag = _start(_LOADS[0], seconds + _SURVIVAL, folder, domain)
    time.sleep(seconds)
    killed_ns = time.time_ns()
    recorder.kill()
    for source in sources:
        source.stop()
    stored = list(_stored(bag / f"{bag.name}_0.mcap"))
    messages = [(topic, data) for topic, data, _ in stored]
    return {
        "seconds": seconds,
        "stored": len(stored),
        "gaps": len(stored) - _intact(messages, len(stored)),
        "lost_s": round((killed_ns - max(log_time for _, _, log_time in stored)) * 1e-9, 3),
    }


def _stored(path: Path) -> Iterator[tuple[str, bytes, int]]:
    """Yield the messages of a file without an end: topic, bytes and log time."""
    from mcap.exceptions import EndOfFile
    from mcap.records import Channel, Message
    from mcap.stream_reader import StreamReader

    topics = {}
    with path.open("rb") as stream, contextlib.suppress(EndOfFile):
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                yield topics[record.channel_id], record.data, record.log_time


def _table(rows: list[dict[str, Any]], killed: dict[str, Any]) -> str:
    heads = f"{'':20}{'sent':>9}{'stored':>9}{'lost (count)':>14}{'lost (content)':>16}"
    lines = [f"{heads}{'CPU %':>8}{'bytes/msg':>11}"]
    lines += [
        f"{row['load']:20}{row['sent']:9d}{row['stored']:9d}{row['lost_by_count']:14d}"
        f"{row['lost_by_content']:16d}{row['cpu_percent']:8.1f}{row['bytes_a_message']:11.1f}"
        for row in rows
    ]
    lines.append(
        f"killed after {killed['seconds']:g} s: {killed['stored']} messages stored, "
        f"{killed['gaps']} gaps, the last {killed['lost_s']:.3f} s lost"
    )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, design=False)
    made.add_argument("--seconds", type=at_least(1.0), default=60.0, help="of recording each load")
    made.add_argument("--publish", action="store_true", help=argparse.SUPPRESS)
    made.add_argument("--first", type=int, help=argparse.SUPPRESS)
    made.add_argument("--topics", type=int, help=argparse.SUPPRESS)
    made.add_argument("--rate", type=float, help=argparse.SUPPRESS)
    options = made.parse_args()
    if options.publish:
        _publish(options)
        return
    with tempfile.TemporaryDirectory() as name:
        folder, domain = Path(name), claim_domain()
        rows = [_measure(load, options.seconds, folder, domain) for load in _LOADS]
        killed = _killed(min(options.seconds, 5.0), folder, domain)
    show({"loads": rows, "killed": killed}, _table(rows, killed), options.json)


if __name__ == "__main__":
    main()
