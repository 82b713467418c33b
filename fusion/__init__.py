# SPDX-License-Identifier: BSD-3-Clause
"""detections to markers to robots; holds the Zenoh router."""
