# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Taking the messages out of a file that may be damaged, with an account of it."""

from collections import Counter
from collections.abc import Callable

from tsobs_ros.bag.mcap.messages import decode_messages
from tsobs_ros.bag.metadata import EMPTY_START_NS
from tsobs_ros.bag.reader import BagMessage
from tsobs_ros.bag.recovery.destinations import Destinations
from tsobs_ros.bag.recovery.pieces import Content, Damage, Found, MessageCount
from tsobs_ros.bag.recovery.report import DamagedPart, FileRecovery
from tsobs_ros.bag.recovery.scan import Scan
from tsobs_ros.bag.recovery.survey import Survey


def harvest(
    told: Survey,
    destinations: Destinations,
    keep: Callable[[BagMessage], None],
    *,
    keep_unchecked: bool = False,
    progress: Callable[[int], object] = lambda _: None,
) -> FileRecovery:
    """Take the messages out of a file, in the order of recording.

    Args:
        told: What the file tells.
        destinations: Where the messages of its channels belong.
        keep: Called with each message.
        keep_unchecked: Also take what can be read of chunks whose checksum fails.
        progress: Called with the number of bytes that were got through since the last call.

    Returns:
        What was kept and what was lost.
    """
    file = FileRecovery(told.path.name, told.size, told.is_finished)
    if told.statistics:
        file.stated = Counter()
        for channel, count in told.statistics.channel_message_counts.items():
            file.stated[destinations[channel][0] or f"channel {channel}"] += count

    def take(records: bytes) -> None:
        for message in decode_messages(records, destinations):
            topic, reason, _, log_time, publish_time = message
            if not topic:
                file.dropped[reason] += 1
            elif max(log_time, publish_time) >= EMPTY_START_NS:
                file.dropped[f"of {topic}, whose times do not fit 63 bits"] += 1
            else:
                keep(message)
                file.keep(topic, log_time)

    damaged: DamagedPart | None = None
    with told.path.open("rb") as stream:
        for piece in Scan(stream, told.size, progress, with_unchecked=keep_unchecked).pieces():
            match piece:
                case MessageCount():
                    # The indexes of a chunk follow it, also where the chunk is damaged.
                    if damaged is not None:
                        damaged.messages = (damaged.messages or 0) + piece.messages
                case Damage():
                    take(piece.unchecked)
                    damaged = DamagedPart(piece.offset, piece.size, piece.reason)
                    file.damage.append(damaged)
                case Content():
                    take(piece.records)
                    damaged = None
                case Found():
                    damaged = None
    return file
