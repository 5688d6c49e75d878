# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A digest of the C sources, which reveals a core that was built from other sources.

setup.py runs this file when it builds the core, and the package does when it loads the core.
"""

import hashlib
from pathlib import Path


def digest(folder: Path) -> str:
    """Return a digest of the C sources in a folder, empty if there are none."""
    files = sorted((*folder.glob("*.c"), *folder.glob("*.h")))
    whole = hashlib.sha256()
    for file in files:
        content = file.read_bytes().replace(b"\r\n", b"\n")
        whole.update(f"{file.name} {len(content)}\n".encode() + content)
    return whole.hexdigest()[:16] if files else ""
