# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The targets of fuzzing: everything that reads a file, with good files to start from."""

import random
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_mutations import mutated_bytes, mutated_text
from mcap.writer import CompressionType, Writer

from tsobs_ros.api import estimate_bag
from tsobs_ros.bag.joint_states import JointStateDecoder, JointStateEncoder
from tsobs_ros.bag.reader import BagReader
from tsobs_ros.bag.recovery import recover
from tsobs_ros.bag.verification import verify
from tsobs_ros.bag.writer import BagWriter
from tsobs_ros.design.file import load_request, parse_design, save_design
from tsobs_ros.design.synthesis import synthesise
from tsobs_ros.methods import ObserverSettings, make_estimator
from tsobs_ros.resources import SHIPPED_DESIGN, config_path

Mutate = Callable[[bytes, Sequence[bytes], random.Random], bytes]


@dataclass(frozen=True)
class Target:
    """Something that reads files.

    Attributes:
        seeds: Good files.
        mutate: Makes a hostile file from a good one.
        read: Reads the file at a path; may raise a TsobsError and nothing else.
        file_name: Name of the file inside its folder.
    """

    seeds: tuple[bytes, ...]
    mutate: Mutate
    read: Callable[[Path], Any]
    file_name: str


def design_target(_: Path) -> Target:
    """Return the arm's design files: one that holds must also step, to finite numbers."""

    def read(path: Path) -> None:
        design = parse_design(path)
        if design.certificate.holds:
            _step(make_estimator(design, ObserverSettings()))

    return Target(_shipped("*.design.yaml"), mutated_text, read, "my.design.yaml")


def request_target(_: Path) -> Target:
    """Return requests for designs of the arm."""
    return Target(_shipped("elastic*.request.yaml"), mutated_text, load_request, "my.request.yaml")


def ts_target(folder: Path) -> Target:
    """Return requests and designs for T–S systems."""
    request = config_path("ts_example.request.yaml")
    design = folder / "ts.design.yaml"
    save_design(synthesise(load_request(request)), design)

    def read(path: Path) -> None:
        (parse_design if b"certificate" in path.read_bytes() else load_request)(path)

    return Target((request.read_bytes(), design.read_bytes()), mutated_text, read, "my.yaml")


def metadata_target(folder: Path) -> Target:
    """Return a bag folder's metadata.yaml, next to a good MCAP file."""
    bag = _bag(folder / "bag", "zstd")
    (file,) = bag.glob("*.mcap")
    content = file.read_bytes()

    def read(path: Path) -> None:
        beside = path.with_name(file.name)
        if not beside.exists():
            beside.write_bytes(content)
        BagReader(path.parent)

    return Target(((bag / "metadata.yaml").read_bytes(),), mutated_text, read, "metadata.yaml")


def bag_target(folder: Path) -> Target:
    """Return MCAP files: compressed, plain, and without checksums, which hide other checks."""
    seeds = [
        next(_bag(folder / name, name).glob("*.mcap")).read_bytes()
        for name in ("none", "lz4", "zstd")
    ]
    seeds.append(_without_checksums(folder / "unchecked.mcap"))

    def read(path: Path) -> None:
        for _ in BagReader(path).decoded():
            pass

    return Target(tuple(seeds), mutated_bytes, read, "bag.mcap")


def recovery_target(folder: Path) -> Target:
    """Return the same files, to verify and to recover."""

    def read(path: Path) -> None:
        output = path.parent / "recovered"
        try:
            verify(path)
            recover(path, output)
            for _ in BagReader(output).messages():
                pass
        finally:
            shutil.rmtree(output, ignore_errors=True)

    return Target(bag_target(folder).seeds, mutated_bytes, read, "bag.mcap")


def message_target(_: Path) -> Target:
    """Return serialized measurement messages."""
    decode = JointStateDecoder()
    seeds = tuple(
        JointStateEncoder(names)(10**9, values, (), values)
        for names, values in ((["joint"], [0.1]), (["a", "bc", "def"], [0.1, 0.2, 0.3]))
    )
    return Target(seeds, mutated_bytes, lambda path: decode(path.read_bytes()), "message")


def log_target(_: Path) -> Target:
    """Return logs of an arm."""
    rows = b"0.0,1.5,0.1\n0.005,1.6,0.2\n0.01,nan,\n0.015,1.7,0.1\n"
    logs = (
        b"time [s],angle [deg],torque [N m]\n" + rows,
        "sep=;\nZeit [s];Winkel [°];Moment\nms;deg;Nm\n".encode()
        + rows.replace(b",", b";").replace(b".", b","),
        b"header.stamp.sec,header.stamp.nanosec,position[0],effort[0]\n17,5000000,0.1,1\n",
        b"time,q1,tau1\n23:59:59.995,0.1,1\n00:00:00,0.1,1\n",
    )
    return Target(logs, mutated_text, estimate_bag, "log.csv")


TARGETS: Mapping[str, Callable[[Path], Target]] = {
    "design": design_target,
    "request": request_target,
    "ts": ts_target,
    "metadata": metadata_target,
    "bag": bag_target,
    "recovery": recovery_target,
    "message": message_target,
    "log": log_target,
}
"""Functions that make the targets, by name, given an empty folder for good files."""


def _shipped(pattern: str) -> tuple[bytes, ...]:
    folder = config_path(SHIPPED_DESIGN).parent
    return tuple(path.read_bytes() for path in sorted(folder.glob(pattern)))


def _step(estimator: Any) -> None:
    state, _ = estimator.correct(estimator.initial(), np.array([0.1]))
    state = estimator.predict(state, np.array([0.5]), estimator.period)
    readout = estimator.readout(state)
    if not (np.isfinite(readout.state).all() and np.isfinite(readout.state_bound).all()):
        raise AssertionError(f"a design that is accepted steps to {readout}")


_STRING = "std_msgs/msg/String"


def _message(number: int) -> bytes:
    text = f"message {number}".encode() + b"\x00"
    return b"\x00\x01\x00\x00" + len(text).to_bytes(4, "little") + text


def _bag(path: Path, compression: str) -> Path:
    with BagWriter(path, compression=compression) as writer:
        writer.add_topic("/a", _STRING)
        writer.add_topic("/b", "sensor_msgs/msg/JointState")
        for number in range(20):
            writer.write("/a", _message(number), number, number)
    return path


def _without_checksums(path: Path) -> bytes:
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, chunk_size=300, enable_crcs=False)
        writer.start(profile="ros2")
        schema = writer.register_schema(_STRING, "ros2msg", b"string data\n")
        channel = writer.register_channel("/a", "cdr", schema)
        for number in range(20):
            writer.add_message(channel, number, _message(number), number)
        writer.finish()
    return path.read_bytes()
