# SPDX-License-Identifier: BSD-3-Clause
"""Calibrates lenses, camera poses and the world frame."""
