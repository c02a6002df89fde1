"""Texts from data on pages that read some characters as more than themselves."""

from __future__ import annotations

import re

from pse_analysis.vocabulary.columns import CONTROL

_HTML = (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"))
_MARKDOWN = re.compile(r"([\\`*_\[\]|~$])")
_BLOCK = re.compile(r"^(\s*\d*)(#|[+-](?=\s)|=(?==*$)|(?<=\d)[.)](?=\s))")


def markdown_text(text: str) -> str:
    """A text that Markdown shows as it is: no link, image, HTML, table or heading comes of it.

    A name from a table of telemetry may hold what a page would read as markup. Underscores inside
    of words are none and stay.
    """
    text = CONTROL.sub(" ", text)
    for sign, entity in _HTML:
        text = text.replace(sign, entity)
    text = _MARKDOWN.sub(_escaped, text)
    return _BLOCK.sub(r"\1\\\2", text)


def _escaped(match: re.Match[str]) -> str:
    text, at = match.string, match.start()
    inside = 0 < at < len(text) - 1 and text[at - 1].isalnum() and text[at + 1].isalnum()
    return match[0] if match[0] == "_" and inside else f"\\{match[0]}"
