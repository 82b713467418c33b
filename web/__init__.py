# SPDX-License-Identifier: BSD-3-Clause
"""The live view in a browser (Viser), and the demo."""
