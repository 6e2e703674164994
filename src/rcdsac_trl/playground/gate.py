"""The gate before the pages: whose browser may come in, and a sentence for who may not, before a page is made."""

import re
from collections.abc import Callable, Mapping, Sequence
from html import escape
from http.client import responses
from pathlib import Path
from string import Template
from typing import Any

from tornado.httputil import HTTPHeaders, HTTPServerRequest, ResponseStartLine
from tornado.routing import AnyMatches, Matcher, Router, Rule, RuleRouter

from rcdsac_trl.errors import UserInputError
from rcdsac_trl.playground.palette import style_sheet
from rcdsac_trl.playground.scene_choice import shortened

_HERE = Path(__file__).parent
_BAD_LINK, _UNKNOWN_NAME, _NOWHERE, _FULL = 400, 403, 404, 503
_USUAL = '<a href="/">Open the usual scene.</a>'
_WAYS_ON = {_BAD_LINK: _USUAL, _NOWHERE: _USUAL, _FULL: '<a href="">Try again.</a>', _UNKNOWN_NAME: ""}
# A page that found no room asks again by itself, s.
_AGAIN_S = 5
# All that there is: the page, what Bokeh's pages ask for, and films.
_PLACES = re.compile(r"/|/ws|/static/.*|/films/[^/]+")
# What a browser leaves out of the name that it asks.
_USUAL_PORTS = (80, 443)


class TooManyPages(UserInputError):
    """No further page can be shown now."""


def guarded(pages: Router, known: Sequence[str], check: Callable[[Mapping[str, str]], object]) -> RuleRouter:
    """Put a gate before pages.

    Args:
        pages: answers what is let through.
        known: ``<name>:<port>`` under which browsers may come. Another name that leads here is a page's of elsewhere.
        check: refuses a page's query that no page is made of.
    """
    return RuleRouter([Rule(_Refused(known, check), _answer), Rule(AnyMatches(), pages)])


def query_of(arguments: Mapping[str, list[bytes]]) -> dict[str, str]:
    """Return a link's query, of each key its last value."""
    return {key: values[-1].decode(errors="replace") for key, values in arguments.items() if values}


class _Refused(Matcher):
    """Matches what is answered with a sentence."""

    def __init__(self, known: Sequence[str], check: Callable[[Mapping[str, str]], object]) -> None:
        self._known, self._check = known, check

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        """Return status and sentence of a request that is refused; None for others."""
        name = request.host.lower()
        if name not in self._known and not any(f"{name}:{port}" in self._known for port in _USUAL_PORTS):
            shown = name if ":" in name else f"{name}:{_USUAL_PORTS[0]}"
            sentence = f"this server is not known as {shown}: start it with origins=[{shown}], or use {self._known[0]}"
            return {"status": _UNKNOWN_NAME, "sentence": sentence}
        if not _PLACES.fullmatch(request.path):
            return {"status": _NOWHERE, "sentence": f"there is no {shortened(request.path)} here: the page is at /"}
        if request.path != "/" or request.method != "GET":
            return None
        if _is_of_elsewhere(request.headers):
            sentence = "another page asks for this one, and shows it to nobody: open it in a tab of its own"
            return {"status": _UNKNOWN_NAME, "sentence": sentence}
        try:
            self._check(query_of(request.arguments))
        except TooManyPages as error:
            return {"status": _FULL, "sentence": str(error)}
        except UserInputError as error:
            return {"status": _BAD_LINK, "sentence": str(error)}
        return None


def _is_of_elsewhere(headers: HTTPHeaders) -> bool:
    """Return whether a page of another site loads this one as a picture or the like, which would take a place here."""
    is_shown = headers.get("Sec-Fetch-Dest", "document") in ("document", "iframe")
    return headers.get("Sec-Fetch-Site") == "cross-site" and not is_shown


def _answer(request: HTTPServerRequest, status: int, sentence: str) -> None:
    page, css = ((_HERE / name).read_text("utf-8") for name in ("refusal.html", "page.css"))
    told = Template(page).substitute(
        palettes=style_sheet(),
        css=css,
        sentence=escape(sentence) + ".",
        way_on=_WAYS_ON[status],
        again=f'<meta http-equiv="refresh" content="{_AGAIN_S}">\n' if status == _FULL else "",
    )
    body = told.encode()
    headers = HTTPHeaders(
        {"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(body)), "Cache-Control": "no-store"}
    )
    assert request.connection is not None
    request.connection.write_headers(ResponseStartLine("HTTP/1.1", status, responses[status]), headers, body)
    request.connection.finish()
