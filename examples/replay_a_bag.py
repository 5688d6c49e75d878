# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimates over a recorded bag or a CSV log, their figures of merit, and a new bag with them.

Usage: python replay_a_bag.py BAG|LOG.csv [NEWBAG]
"""

import sys

import numpy as np

import tsobs_ros as ts

if len(sys.argv) < 2:
    sys.exit(__doc__)
path = sys.argv[1]
output = sys.argv[2] if len(sys.argv) > 2 else None

try:
    whole = ts.estimate_bag(path, output=output)
except ts.TsobsError as error:
    sys.exit(f"error: {error}")

for joint, estimates in whole.joints.items():
    span = estimates.time[-1] - estimates.time[0]
    print(f"{joint}: {len(estimates.time)} estimates over {span:.1f} s")
    print(f"  proved bound in {estimates.proved.mean():.0%} of them")
    print(f"  innovation {np.sqrt(np.mean(estimates.innovation**2)):.4f} rad RMS")
    print(f"  sensor disturbance at the end {estimates.disturbance[-1]:+.4f} rad")
    print(f"  rejected: {estimates.rejected or 'none'}")
if whole.reproduced is not None:
    print(f"{whole.reproduced:.1%} of the live estimates reproduced to the last bit")
print(*whole.remarks, sep="\n")

print(ts.compare(path, methods=["certified", "ekf"]))

if output is not None:
    reader = ts.BagReader(output)
    for name, topic in reader.topics.items():
        print(f"{output}: {topic.count} messages on {name}")
