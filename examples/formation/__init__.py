# SPDX-License-Identifier: BSD-3-Clause
"""Example: three robots hold a formation by what their own cameras locate; `roundel demo --relative` runs it."""
