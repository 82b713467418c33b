# SPDX-License-Identifier: BSD-3-Clause
"""the live view in Viser, and the demo."""
