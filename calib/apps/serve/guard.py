"""Check of who may request a served page: this computer's names, the token, and no page of another site."""

import hmac
import ipaddress
import socket
from urllib.parse import urlsplit

from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send


class Guard:
    """Middleware that refuses requests without the token.

    It also refuses requests for another host name (DNS rebinding), and POST requests from other sites' pages.

    Args:
        app: the web application.
        token: the token; empty: none is required.
        host: host name that is accepted besides numeric addresses and this computer's names.
    """

    def __init__(self, app: ASGIApp, token: str, host: str) -> None:
        self.app = app
        self.token = token
        name = socket.gethostname()
        names = ("localhost", host, name, f"{name}.local", socket.getfqdn())
        self.names = {name.lower() for name in names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        responder = self.app
        if scope["type"] == "http":
            responder = self._answer(Request(scope)) or self.app
        await responder(scope, receive, send)

    def _answer(self, request: Request) -> Response | None:
        """Return the response to a refused request, or to one that sets the token's cookie; None for other requests."""
        requested_host = request.headers.get("host", "")
        if not self._is_ours(requested_host):
            return PlainTextResponse(
                "This page is not served under this host name: open the address that calib serve printed.", 403
            )
        if request.method != "GET":
            origin = request.headers.get("origin")
            other_origin = origin is not None and urlsplit(origin).netloc != requested_host
            site = request.headers.get("sec-fetch-site", "same-origin")
            if other_origin or site not in ("same-origin", "none"):
                return PlainTextResponse("Another site's page asked for this; nothing was changed.", 403)
        cookie = f"calib-{urlsplit(f'//{requested_host}').port or 80}"
        if self.token and not self._knows(request.cookies.get(cookie, "")):
            if request.method != "GET" or not self._knows(request.query_params.get("token", "")):
                message = "This page needs its token: open the whole address that calib serve printed."
                return PlainTextResponse(message, 403)
            answer = RedirectResponse(request.url.path, 303)
            answer.set_cookie(cookie, self.token, httponly=True, samesite="strict")
            return answer
        return None

    def _is_ours(self, requested_host: str) -> bool:
        try:
            name = urlsplit(f"//{requested_host}").hostname or ""
        except ValueError:
            return False
        try:
            # Nobody can rebind a number.
            ipaddress.ip_address(name)
            return True
        except ValueError:
            return name in self.names

    def _knows(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.token.encode())
