# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bad input by kinds, and what plays it to an observer: in a test, or to one that runs.

``kinds`` is the catalogue; ``stage`` runs observers in the test's process under a time that the
test decides; ``live`` plays to a node somewhere else and prints what became of every kind::

    PYTHONPATH=test/nodes python -m faults --help
"""
