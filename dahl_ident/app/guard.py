"""Who may use the page: this machine's user, from the page itself."""

from __future__ import annotations

import hmac
from typing import TYPE_CHECKING

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class Guard:
    """Refuses requests without the token, by another name of this machine, or from other pages.

    The token is in the address at first, then in a cookie that no other site's requests carry;
    `limit` is the size of one request's body in bytes.
    """

    def __init__(self, app: ASGIApp, token: str, port: int, limit: int) -> None:
        self._app, self._token, self._limit = app, token.encode(), limit
        self._hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}
        self._cookie = f"dahl_ident_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        if scope["type"] == "http":
            refused = self._answer(Request(scope))
            await (refused or self._app)(scope, receive, answer)
        else:
            await self._app(scope, receive, send)

    def _answer(self, request: Request) -> Response | None:
        """Return the answer to a request that is not passed on."""
        if request.headers.get("host") not in self._hosts:
            return PlainTextResponse("This server answers to 127.0.0.1 alone.", 421)
        origin, reads = request.headers.get("origin"), request.method in ("GET", "HEAD")
        if (origin or not reads) and origin not in {f"http://{host}" for host in self._hosts}:
            return PlainTextResponse("The request comes from another page.", 403)
        if self._is_token(request.query_params.get("token", "")):
            response = RedirectResponse(request.url.path, 303)
            token = self._token.decode()
            response.set_cookie(self._cookie, token, httponly=True, samesite="strict")
            return response
        if not self._is_token(request.cookies.get(self._cookie, "")):
            text = "Open the address with its token, as the terminal printed it."
            return PlainTextResponse(text, 403)
        size = request.headers.get("content-length", "" if not reads else "0")
        if not size.isdecimal():
            return PlainTextResponse("The request does not say how long it is.", 411)
        if int(size) > self._limit:
            text = f"The files are larger than {self._limit / 1e6:.0f} MB; send fewer at once."
            return PlainTextResponse(text, 413)
        return None

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self._token)
