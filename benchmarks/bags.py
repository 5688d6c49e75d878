# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Speed of writing bags, reading them in order of log time, verifying and recovering them.

Messages have 156 bytes and are on ten topics; the library runs alone, without ROS. The libraries
`mcap` and `rosbags` do the same in the same run, in turns; all give raw bytes. Times are elapsed
times and include opening and closing, which forces the bag to the disk.
"""

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from common import at_least, parser, show, timed
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Reader as RosbagsReader
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from tsobs_ros.bag import BagReader, BagWriter
from tsobs_ros.bag.definitions import find_definition
from tsobs_ros.bag.joint_states import JOINT_STATE, JointStateEncoder
from tsobs_ros.bag.recovery import recover
from tsobs_ros.bag.verification import verify
from tsobs_ros.bag.writer import CHUNK_SIZE

_TOPICS = [f"/topic_{k}" for k in range(10)]
_START = 1_700_000_000_000_000_000
_STEP = 100_000
_NAMES = [f"joint_{k}" for k in range(3)]

Message = tuple[str, bytes, int]


def _messages(count: int) -> list[Message]:
    """Return messages of an arm in the form that a recorder gets."""
    rng = np.random.default_rng(1)
    encode = JointStateEncoder(_NAMES)
    stamps = range(_START, _START + count * _STEP, _STEP)
    values = rng.normal(size=(count, 3)).round(4).tolist()
    made = [
        (_TOPICS[k % len(_TOPICS)], encode(stamp, value, value, value), stamp)
        for k, (stamp, value) in enumerate(zip(stamps, values, strict=True))
    ]
    assert {len(data) for _, data, _ in made} == {156}
    return made


def _write_ours(path: Path, messages: list[Message], compression: str) -> None:
    with BagWriter(path, compression=compression) as writer:
        for topic in _TOPICS:
            writer.add_topic(topic, JOINT_STATE)
        for topic, data, stamp in messages:
            writer.write(topic, data, stamp, stamp)


def _write_mcap(path: Path, messages: list[Message], compression: str) -> None:
    definition = find_definition(JOINT_STATE)
    path.mkdir()
    with (path / "bag.mcap").open("wb") as stream:
        writer = Writer(stream, CHUNK_SIZE, CompressionType[compression.upper()])
        writer.start(profile="ros2")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", definition.text.encode())
        channels = {topic: writer.register_channel(topic, "cdr", schema) for topic in _TOPICS}
        for topic, data, stamp in messages:
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()


def _write_rosbags(path: Path, messages: list[Message], compression: str) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = RosbagsWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if compression != "none":
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat[compression.upper()])
    with writer:
        connections = {
            topic: writer.add_connection(topic, JOINT_STATE, typestore=store) for topic in _TOPICS
        }
        for topic, data, stamp in messages:
            writer.write(connections[topic], stamp, data)


def _read_ours(path: Path) -> int:
    return sum(1 for _ in BagReader(path).messages())


def _read_mcap(path: Path) -> int:
    with (path / f"{path.name}_0.mcap").open("rb") as stream:
        return sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())


def _read_rosbags(path: Path) -> int:
    with RosbagsReader(path) as reader:
        return sum(1 for _ in reader.messages())


def _measure(
    folder: Path, messages: list[Message], compression: str, repeats: int
) -> dict[str, dict[str, float]]:
    """Return the rates of one compression, messages/s, by task and library."""
    bag, scratch = folder / "bag", folder / "scratch"
    _write_ours(bag, messages, compression)
    writers = {"ours": _write_ours, "mcap": _write_mcap, "rosbags": _write_rosbags}
    readers = {"ours": _read_ours, "mcap": _read_mcap, "rosbags": _read_rosbags}
    if compression == "lz4":
        del writers["rosbags"]  # it cannot write lz4
    times: dict[tuple[str, str], list[float]] = {}
    for _ in range(repeats):
        for name, write in writers.items():
            seconds = timed(lambda w=write: w(scratch, messages, compression))
            times.setdefault(("write", name), []).append(seconds)
            shutil.rmtree(scratch)
        for name, read in readers.items():
            times.setdefault(("read", name), []).append(timed(lambda r=read: r(bag)))
        times.setdefault(("verify", "ours"), []).append(timed(lambda: verify(bag)))
        times.setdefault(("recover", "ours"), []).append(timed(lambda: recover(bag, scratch)))
        shutil.rmtree(scratch)
    assert verify(bag).holds
    assert _read_ours(bag) == len(messages)
    shutil.rmtree(bag)
    rates: dict[str, dict[str, float]] = {}
    for (task, name), each in times.items():
        rates.setdefault(task, {})[name] = len(messages) / float(np.median(each))
    return rates


def _text(results: dict[str, Any]) -> str:
    lines = ["messages/s, and how many times as many as the other library", ""]
    for compression, tasks in results.items():
        for task, rates in tasks.items():
            others = ", ".join(
                f"{name} {rate:,.0f} ({rates['ours'] / rate:.1f} x)"
                for name, rate in rates.items()
                if name != "ours"
            )
            line = f"{compression:<5} {task:<8}{rates['ours']:>12,.0f}   {others}"
            lines.append(line.rstrip())
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, design=False)
    made.add_argument("--messages", type=at_least(1, int), default=200_000, metavar="N")
    made.add_argument("--repeats", type=at_least(1, int), default=5, metavar="N")
    made.add_argument("--folder", type=Path, help="where to write (default: a temporary folder)")
    options = made.parse_args()
    messages = _messages(options.messages)
    results = {}
    for compression in ("none", "lz4", "zstd"):
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            results[compression] = _measure(Path(folder), messages, compression, options.repeats)
    show({"messages": options.messages, "rates": results}, _text(results), options.json)


if __name__ == "__main__":
    main()
