"""The reference of the HTTP interface, from openapi.yaml."""

from __future__ import annotations

from typing import Any

import yaml

from scripts.docs_site.repository_links import ROOT

_HEAD = """# HTTP addresses

Made from the [contract](../openapi.yaml). How to use them: [HTTP interface](../api.md). A running service
shows the same at `/docs`, with a form to try each address. What each refusal means: [errors](../errors.md).
"""


def contract_page() -> str:
    contract: dict[str, Any] = yaml.safe_load((ROOT / "openapi.yaml").read_text(encoding="utf-8"))
    by_tag: dict[str, list[str]] = {}
    for path, operations in contract["paths"].items():
        for method, operation in operations.items():
            if method != "head":
                tag = operation.get("tags", ["service"])[0]
                by_tag.setdefault(tag, []).append(_operation(method, path, operation))
    parts = [_HEAD]
    for tag, told in by_tag.items():
        parts += [f"## {tag.capitalize()}", *told]
    return "\n\n".join(parts) + "\n"


def _operation(method: str, path: str, operation: dict[str, Any]) -> str:
    parts = [f"### {method.upper()} {path}", f"**{operation['summary']}.** {operation.get('description', '')}".strip()]
    rows = [
        f"| `{one['name']}` | {one['in']} | {_line(one.get('description', ''))} |"
        for one in operation.get("parameters", [])
    ]
    if rows:
        parts.append("\n".join(["| parameter | in | |", "|---|---|---|", *rows]))
    answers = [f"| {status} | {_line(answer['description'])} |" for status, answer in operation["responses"].items()]
    parts.append("\n".join(["| answer | |", "|---|---|", *answers]))
    return "\n\n".join(parts)


def _line(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
