# SPDX-License-Identifier: BSD-3-Clause
"""Which detections are markers of the wand."""
