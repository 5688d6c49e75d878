# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Play bad input to a running observer, kind by kind, and print what becomes of it."""

import argparse
import sys

from faults.arm import Arm
from faults.kinds import KINDS
from faults.live import play_all
from faults.script import table
from tsobs_ros.estimation.records import NANOSECONDS


def main() -> int:
    """Return 1 if anything was not as it must be."""
    parser = argparse.ArgumentParser(prog="python -m faults", description=__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help="default: all short enough")
    parser.add_argument("--list", action="store_true", help="print the kinds, in Markdown, and end")
    parser.add_argument("--observer", default="/observer", metavar="NAME")
    parser.add_argument("--topic", default="joint_measurements")
    parser.add_argument("--joint", default="elastic_joint")
    parser.add_argument("--longest", type=float, default=30.0, metavar="SECONDS")
    options = parser.parse_args()
    if unknown := set(options.kinds) - set(KINDS):
        parser.error(f"no such kind: {', '.join(sorted(unknown))}; see --list")
    if options.list:
        print(table(Arm(100 * NANOSECONDS)), end="")
        return 0
    asked = [KINDS[name] for name in options.kinds or KINDS]
    kinds = [kind for kind in asked if options.kinds or kind.seconds <= options.longest]
    try:
        outcomes = play_all(kinds, options.observer, options.topic, options.joint)
    except TimeoutError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    wrong = [name for name, outcome in outcomes.items() if outcome.complaints]
    print(f"{len(outcomes) - len(wrong)} of {len(outcomes)} kinds as they must be")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
