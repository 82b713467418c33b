# SPDX-License-Identifier: BSD-3-Clause
"""Adds the pages of the repository's root to the documentation site, with the links of both."""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT_PAGES = ("CONVENTIONS.md", "DECISIONS.md", "CHANGELOG.md", "CONTRIBUTING.md")
TO_ROOT_PAGE = re.compile(
    rf"\]\(\.\./((?:\.\./)?)((?:{'|'.join(ROOT_PAGES)})[^)]*)\)".replace(".md", r"\.md")
)
TO_SOURCE = re.compile(
    r"\[([^]]+)\]\((?:\.\./)*(?:calib|camera_node|examples|fusion|roundel|tests|web)/[^)]*\)"
)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages; MkDocs calls it before it reads any page."""
    for name in ROOT_PAGES:
        path = Path(config.config_file_path).parent / name
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """On the site, pages of the root and of docs/ are in one folder, and source files are not there."""
    if page.file.src_uri in ROOT_PAGES:
        markdown = markdown.replace("](docs/", "](")
    return TO_SOURCE.sub(r"\1", TO_ROOT_PAGE.sub(r"](\1\2)", markdown))
