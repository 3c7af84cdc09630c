"""Server of the setup page."""

import asyncio
import functools
import json
import secrets
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path

from aiohttp import web

from bms_estimator.model.config_file import without_secrets
from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.page.event_stream import LatestValues
from bms_estimator.page.page_server import FILES as PAGE_FILES
from bms_estimator.page.web_server import File, WebServer
from bms_estimator.settings.connections import PageSettings
from bms_estimator.setup.answers import InvalidAnswerError
from bms_estimator.setup.broker_login import BrokerLogin
from bms_estimator.setup.page.session import SetupSession
from bms_estimator.setup.page.view import KEY_FIELD, page

STATIC = Path(__file__).with_name("static")
FILES = {
    "/style.css": PAGE_FILES["/style.css"],
    "/icon.svg": PAGE_FILES["/icon.svg"],
    "/setup.css": File(STATIC / "setup.css", "text/css"),
    "/setup.js": File(STATIC / "setup.js", "text/javascript"),
}
"""Static files by URL path."""

Fields = Mapping[str, str]
"""Fields of a form, by name."""


class SetupServer(WebServer):
    """Server of the setup page of one pack; a context manager.

    Args:
        settings: Address and access of the page.
        file: Settings file to create.
        token: Token that a browser must send if the settings name no token file; None: no token is then required.

    Raises:
        UserError: The token cannot be read.
    """

    def __init__(self, settings: PageSettings, file: Path, token: str | None = None) -> None:
        self._latest_estimate = LatestValues()
        self._session = SetupSession(file, self._show, settings.address.port)
        self._form_key, self._lock = secrets.token_hex(16), asyncio.Lock()
        steps: dict[str, Callable[[Fields], Awaitable[None]]] = {
            "/search": self._search,
            "/login": self._log_in,
            "/device": lambda fields: self._session.choose_device(fields.get("device", "")),
            "/compare/voltage": functools.partial(self._compare, "voltage"),
            "/compare/zero": functools.partial(self._compare, "zero"),
            "/compare/current": functools.partial(self._compare, "current"),
            "/compare/direction": functools.partial(self._compare, "direction"),
            "/continue": lambda _: self._session.finish_comparison(),
            "/pack": self._session.create,
        }
        super().__init__(
            settings,
            FILES,
            self._latest_estimate,
            {"/": self._page},
            forms={path: functools.partial(self._run_step, step) for path, step in steps.items()},
            token=token,
            retry=False,  # the user is at the terminal, and can choose another port
        )

    async def __aexit__(self, *error: object) -> None:
        """End the search or the estimator, and the server."""
        await self._session.close()
        await super().__aexit__(*error)

    def _show(self, estimate: Estimate) -> None:
        """Send an estimate to the page."""
        values = {
            "unknown": estimate.soc is not None and not estimate.soc_known,
            "soc": None if estimate.soc is None else 100.0 * estimate.soc,
            "band": None if estimate.soc_std is None else 200.0 * estimate.soc_std,  # two standard deviations [%]
            "voltage": estimate.voltage_v,
            "current": estimate.current_a,
        }
        self._latest_estimate.set_value("estimate", json.dumps(values))

    async def _page(self, _: web.Request) -> web.StreamResponse:
        return web.Response(
            text=page(self._session, self._form_key), content_type="text/html", headers={"Cache-Control": "no-store"}
        )

    async def _run_step(self, step: Callable[[Fields], Awaitable[None]], request: web.Request) -> web.StreamResponse:
        """Run a step with the fields of a form, and redirect to the page.

        A form without the key of this server is rejected, because another web site may have sent it.
        """
        fields = {name: str(value) for name, value in (await request.post()).items()}
        if not secrets.compare_digest(fields.get(KEY_FIELD, "").encode(), self._form_key.encode()):
            raise web.HTTPForbidden(text="this form belongs to an earlier run of the program; reload the page\n")
        async with self._lock:
            self._session.error = ""
            try:
                await step(fields)
            except (UserError, InvalidAnswerError) as error:
                self._session.error = str(error)
            except Exception as error:  # noqa: BLE001 - the page reports it
                self._session.error = f"{type(error).__name__}: {error}"
        return web.Response(status=303, headers={"Location": "/"})

    async def _search(self, fields: Fields) -> None:
        hidden = {without_secrets(place): place for place in self._session.places}  # the form shows no password
        places = [hidden.get(place, place) for place in fields.get("places", "").split()]
        if not places:
            raise UserError("name at least one place to search")
        self._session.start_search(places)

    async def _log_in(self, fields: Fields) -> None:
        """Search a broker again, with the user name and password that it requires."""
        login = BrokerLogin(*(fields.get(name, "") for name in ("url", "username", "password")))
        self._session.start_search([login.address])

    async def _compare(self, quantity: str, fields: Fields) -> None:
        await self._session.compare(quantity, fields.get("value", "").strip())
