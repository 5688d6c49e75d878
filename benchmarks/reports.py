# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cost of `tsobs report` on a long bag: time, memory, and the size of its page.

The bag is a recorded bag, repeated with later stamps until it is long enough.
"""

import os
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from common import at_least, parser, show

from tsobs_ros.bag.reader import BagReader
from tsobs_ros.bag.writer import BagWriter

_MEASUREMENTS = "joint_measurements"
_PERIOD = 5_000_000


def repeat(bag: Path, output: Path, seconds: float) -> int:
    """Write the messages of a bag repeatedly, and return their number."""
    reader = BagReader(bag)
    messages = list(reader.messages())
    times = [one.log_time for one in messages if one.topic.endswith(_MEASUREMENTS)]
    length = times[-1] - times[0] + _PERIOD
    # Latched messages come before the measurements, and only once.
    latched = [one.log_time < times[0] or one.topic.endswith("/design") for one in messages]
    first = [one for one, is_first in zip(messages, latched, strict=True) if is_first]
    rest = [one for one, is_first in zip(messages, latched, strict=True)
            if not is_first and one.log_time <= times[-1]]  # fmt: skip
    count = max(1, round(1e9 * seconds / length))
    with BagWriter(output) as writer:
        writer.add_topics(reader.topics.values())
        for one in first:
            writer.write(one.topic, one.data, one.log_time, one.publish_time)
        for place in range(count):
            later = place * length
            for one in rest:
                data, times = _shifted(one.data, later), (one.log_time, one.publish_time)
                writer.write(one.topic, data, *(time + later for time in times))
    return len(first) + count * len(rest)


def _shifted(data: bytes, later: int) -> bytes:
    """Return a message, which begins with a header, with a later stamp."""
    seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
    stamp = divmod(seconds * 1_000_000_000 + nanoseconds + later, 1_000_000_000)
    return data[:4] + struct.pack("<iI", *stamp) + data[12:]


def report(bag: Path, output: Path) -> dict[str, Any]:
    """Report on a bag in a separate process, and return its time and memory."""
    begun = time.monotonic()
    command = ["report", str(bag), "--output", str(output), "--json"]
    child = subprocess.Popen(
        [sys.executable, "-m", "tsobs_ros.cli.main", *command], stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(child.pid, 0)
    assert status == 0, command
    return {
        "seconds": time.monotonic() - begun,
        "processor_seconds": usage.ru_utime + usage.ru_stime,
        "megabytes": usage.ru_maxrss / 1000,
        "page_megabytes": (output / "report.html").stat().st_size / 1e6,
    }


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, design=False)
    made.add_argument("bag", type=Path, help="a recorded bag, such as that of the demo")
    made.add_argument("--minutes", type=at_least(0.1), default=10.0, help="length to measure")
    options = made.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder, "bag")
        count = repeat(options.bag, bag, 60.0 * options.minutes)
        # A first report, so that one-time loading does not count.
        report(options.bag, Path(folder, "first"))
        used = report(bag, Path(folder, "report"))
    text = (
        f"tsobs report, {options.minutes:g} min, {count} messages: {used['seconds']:.1f} s, "
        f"{used['processor_seconds']:.1f} s of processors, {used['megabytes']:.0f} MB, page of "
        f"{used['page_megabytes']:.1f} MB"
    )
    show({"minutes": options.minutes, "messages": count, **used}, text, options.json)


if __name__ == "__main__":
    main()
