# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages to be written, in arrays; free of the libraries that files take."""

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Message: TypeAlias = tuple[str, str, bytes, int, int]
"""A `BagMessage` as a plain tuple, whose class would cost more than the rest of it."""


class MessageSeries(NamedTuple):
    """Messages of a topic that have the same size, n of them.

    Attributes:
        topic: The topic.
        type: Its type.
        log_times: ns since the epoch, shape (n,).
        publish_times: ns since the epoch, shape (n,).
        data: In CDR, shape (n, size).
    """

    topic: str
    type: str
    log_times: NDArray[np.int64]
    publish_times: NDArray[np.int64]
    data: NDArray[np.uint8]

    def take(self, chosen: NDArray[Any] | slice) -> "MessageSeries":
        """Return some of the messages."""
        times = self.log_times[chosen], self.publish_times[chosen]
        return MessageSeries(self.topic, self.type, *times, self.data[chosen])

    def messages(self) -> list[Message]:
        """Return them one by one."""
        times = zip(self.log_times.tolist(), self.publish_times.tolist(), strict=True)
        rows = zip(self.data, times, strict=True)
        return [(self.topic, self.type, row.tobytes(), *each) for row, each in rows]
