"""Hooks of mkdocs: pages that are made, files from outside of docs/, lists and links as it wants them."""

from __future__ import annotations

from typing import Any

from mkdocs.structure.files import File, Files

from scripts.docs_site.command_page import command_page
from scripts.docs_site.contract_page import contract_page
from scripts.docs_site.lists import with_plain_lists
from scripts.docs_site.repository_links import files_outside_docs, site_name, with_site_links

MADE = {"reference/command-line.md": command_page, "reference/http.md": contract_page}


def on_files(files: Files, config: Any) -> Files:
    for name, make in MADE.items():
        files.append(File.generated(config, name, content=make()))
    for file in sorted(files_outside_docs()):
        name = site_name(file)
        if files.get_file_from_path(name) is None:
            files.append(File.generated(config, name, abs_src_path=str(file)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    return with_plain_lists(with_site_links(markdown, page.file.src_uri))
