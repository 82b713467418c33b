# SPDX-License-Identifier: BSD-3-Clause
"""Adds the pages of the repository's root to the documentation site, with the links of both."""

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT_PAGES = ("CONVENTIONS.md", "DECISIONS.md", "CHANGELOG.md")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages; MkDocs calls it before it reads any page."""
    for name in ROOT_PAGES:
        path = Path(config.config_file_path).parent / name
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """On the site, pages of the root and of docs/ are in one folder."""
    return markdown.replace("](docs/" if page.file.src_uri in ROOT_PAGES else "](../", "](")
