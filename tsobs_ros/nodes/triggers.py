# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Services that are called without arguments and say what came of it: std_srvs/Trigger."""

from collections.abc import Callable, Mapping

from rclpy.node import Node
from std_srvs.srv import Trigger

Answer = Callable[[], tuple[bool, str]]
"""Does what a service is called for; returns its success, and what to tell the caller."""


def offer_triggers(node: Node, answers: Mapping[str, Answer]) -> None:
    """Offer services below the node's own name.

    Args:
        node: The node that offers them.
        answers: What each does, by its name.
    """
    for name, answer in answers.items():
        node.create_service(Trigger, f"~/{name}", _callback(answer))


def _callback(
    answer: Answer,
) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
    def callback(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = answer()
        return response

    return callback
