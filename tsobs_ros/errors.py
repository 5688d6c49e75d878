# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of this package: one root, subclasses that are also the expected builtin."""


class TsobsError(Exception):
    """Root of every error raised on purpose by this package; its text is meant for the user."""


class ModelError(TsobsError, ValueError):
    """A model, signal or measurement does not make sense (shape, sign, range, finiteness)."""


class DesignError(TsobsError, RuntimeError):
    """A gain could not be designed: the solver failed or its answer did not pass the re-check."""


class DetectabilityError(DesignError):
    """A design cannot exist because a mode of the error system is not seen by the sensor."""


class DesignFileError(TsobsError, ValueError):
    """A design file is missing, malformed or does not describe a design."""


class CertificateError(DesignFileError):
    """A design file is well formed but its certificate does not hold."""


class ParameterError(TsobsError, ValueError):
    """A ROS parameter is unknown, of the wrong type or out of range."""


class BagReadError(TsobsError, OSError):
    """A bag cannot be read: missing, truncated, of another format or with unknown definitions."""


class BagWriteError(TsobsError, OSError):
    """A bag cannot be written: the folder exists, the disk is full, or a topic is inconsistent."""


class ExportError(TsobsError, OSError):
    """A topic cannot be written to a file: it exists, or the disk is full."""


class LogError(TsobsError, ValueError):
    """An arm's own log cannot be read: a column is missing, or a cell is not what it should be."""


class MessageError(TsobsError, ValueError):
    """A message cannot be read or written: its bytes or its values do not fit its type."""


class NodeError(TsobsError, RuntimeError):
    """A node cannot start or go on, for a reason its user can act on."""


def printable(text: str) -> str:
    """Return a text with everything escaped that a terminal would obey instead of showing it.

    What is said of bags and files repeats names that are in them, and those may be anything.
    """
    return "".join(
        c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text
    )
