# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Punctuality and cost of the player with a bag of 1 kHz, at several rates.

The player runs as it is installed. This process receives everything, and the middleware stamps the
times at which each message left the player and arrived. Errors are relative to the most punctual
message, because the two processes do not share a steady clock.
"""

import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from common import at_least, claim_domain, join_ros, parser, show

_SENSOR_RATE = 1000
_START = 1_700_000_000 * 10**9
_TOPIC = "/joint_measurements"
_QUANTILES = {"p50": 0.5, "p99": 0.99, "max": 1.0}
_DEPTH = 100_000
_DRAIN_PERIOD = 0.2
_START_TIMEOUT = 30.0
_SILENCE = 5.0


def _write_bag(path: Path, seconds: float) -> int:
    from tsobs_ros.bag import BagWriter, QosProfile
    from tsobs_ros.bag.joint_states import JointStateEncoder

    encode, count = JointStateEncoder([f"joint_{k + 1}" for k in range(7)]), 0
    with BagWriter(path) as writer:
        writer.add_topic(_TOPIC, "sensor_msgs/msg/JointState", [QosProfile()])
        for count in range(1, round(seconds * _SENSOR_RATE) + 1):
            stamp = _START + count * 10**9 // _SENSOR_RATE
            writer.write(_TOPIC, encode(stamp, [count * 1e-6] * 7), stamp, stamp)
    return count


def _receive(count: int) -> dict[str, list[int]]:
    """Return times of sending and arrival, and stamps, of messages [ns], until no more come."""
    import rclpy
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState

    from tsobs_ros.bag.joint_states import JointStateDecoder
    from tsobs_ros.nodes.wire import DrainedSubscription

    node, decode = rclpy.create_node("receiver"), JointStateDecoder()
    subscription = DrainedSubscription(node, JointState, _TOPIC, QoSProfile(depth=_DEPTH), raw=True)
    received: dict[str, list[int]] = {"sent": [], "arrived": [], "stamps": []}
    patience = _START_TIMEOUT
    while len(received["stamps"]) < count and patience > 0.0:
        time.sleep(_DRAIN_PERIOD)
        patience -= _DRAIN_PERIOD
        for data, info in subscription.drain():
            patience = _SILENCE
            received["sent"].append(info["source_timestamp"])
            received["arrived"].append(info["received_timestamp"])
            received["stamps"].append(decode(data).stamp)
    node.destroy_node()
    return received


def _quantiles(errors: list[float]) -> dict[str, float]:
    ordered = sorted(errors)
    return {
        name: round(ordered[min(len(ordered) - 1, int(q * len(ordered)))] * 1e-6, 4)
        for name, q in _QUANTILES.items()
    }


def _relative(times: list[int], stamps: list[int], rate: float) -> list[float]:
    late = [t - s / rate for t, s in zip(times, (s - stamps[0] for s in stamps), strict=True)]
    return [error - min(late) for error in late]


def _measure(rate: float, seconds: float, folder: Path, domain: int) -> dict[str, Any]:
    from node_processes import executable

    bag = folder / f"bag_{rate:g}"
    count = _write_bag(bag, seconds * rate)
    parameters = {"bag": str(bag), "rate": rate, "wait_timeout": 0.0}
    process = executable("player", parameters, folder, domain)
    received = _receive(count)
    used = process.cpu_seconds()
    if (code := process.stop()) != 0:
        sys.exit(f"the player ended with {code}:\n{process.output}")
    stamps = received["stamps"]
    return {
        "rate": rate,
        "messages_per_second": _SENSOR_RATE * rate,
        "lost": count - len(stamps),
        "in_order": stamps == sorted(stamps),
        "sent_ms": _quantiles(_relative(received["sent"], stamps, rate)),
        "arrived_ms": _quantiles(_relative(received["arrived"], stamps, rate)),
        "cpu_percent": round(100.0 * used / seconds, 1),
    }


def _table(rows: list[dict[str, Any]]) -> str:
    heads = "".join(f"{what + ' ' + name:>14}" for what in ("sent", "arrived")
                    for name in _QUANTILES)  # fmt: skip
    lines = [f"{'rate':>5}{'msg/s':>7}{'lost':>6}{heads}{'CPU %':>8}   errors in ms"]
    for row in rows:
        numbers = "".join(
            f"{row[key][name]:14.3f}" for key in ("sent_ms", "arrived_ms")
            for name in _QUANTILES
        )  # fmt: skip
        lines.append(
            f"{row['rate']:5g}{row['messages_per_second']:7g}{row['lost']:6d}{numbers}"
            f"{row['cpu_percent']:8.1f}{'' if row['in_order'] else '   out of order'}"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, design=False)
    made.add_argument("--seconds", type=at_least(1.0), default=60.0, help="of playing at each rate")
    made.add_argument("--rates", type=at_least(0.01), nargs="+", default=[0.5, 1.0, 2.0])
    options = made.parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    domain = claim_domain()
    rclpy = join_ros(domain)
    with tempfile.TemporaryDirectory() as name:
        rows = [_measure(rate, options.seconds, Path(name), domain) for rate in options.rates]
    rclpy.shutdown()
    show({"seconds": options.seconds, "rates": rows}, _table(rows), options.json)


if __name__ == "__main__":
    main()
