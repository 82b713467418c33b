# SPDX-License-Identifier: BSD-3-Clause
"""The server: fuses detections into markers and robot poses, and is the arena's Zenoh router."""
