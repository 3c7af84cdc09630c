"""Headless Chromium, which all tests of a module share, and tabs with their console errors and requests."""

import contextlib
import shutil
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from playwright.async_api import Browser, Page, async_playwright

from tests.patience import LONG_S

CHROMIUM = shutil.which("chromium")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
DESKTOP, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
"""Sizes of the viewport [px]."""


@contextlib.asynccontextmanager
async def chromium() -> AsyncIterator[Browser]:
    """Start Chromium with an empty profile."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed (apt-get install chromium)")
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS, timeout=1e3 * LONG_S)
        yield browser
        await browser.close()


@dataclass
class Tab:
    """Tab with a page.

    Attributes:
        page: Page in Playwright.
        errors: Errors on its console.
        requests: URLs that it has requested.
    """

    page: Page
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    async def text(self, quantity: str) -> str:
        """Return the text that is shown for a quantity (its attribute ``data-q``); empty if the quantity is hidden."""
        element = self.page.locator(f'[data-q="{quantity}"]')
        return await element.inner_text() if await element.is_visible() else ""

    async def until(self, condition: str, argument: Any = None) -> None:
        """Wait until a JavaScript expression is true."""
        await self.page.wait_for_function(condition, arg=argument, polling=100)

    async def until_status(self, text: str) -> None:
        """Wait until the status line contains this text."""
        await self.until("text => document.getElementById('status').innerText.includes(text)", text)

    async def until_text(self, quantity: str, text: str) -> None:
        """Wait until a quantity is shown with this text; empty: until the quantity is hidden."""
        await self.until(
            """([name, text]) => {
                const element = document.querySelector(`[data-q="${name}"]`);
                return (element.checkVisibility() ? element.innerText : "") === text;
            }""",
            [quantity, text],
        )


@contextlib.asynccontextmanager
async def tab(browser: Browser, url: str, *, size: dict[str, int] = DESKTOP, **options: Any) -> AsyncIterator[Tab]:
    """Open a page as a new visitor."""
    context = await browser.new_context(viewport=size, **options)  # type: ignore[arg-type]
    context.set_default_timeout(1e3 * LONG_S)
    page = await context.new_page()
    page_tab = Tab(page)
    page.on("console", lambda message: page_tab.errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: page_tab.errors.append(str(error)))
    page.on("request", lambda request: page_tab.requests.append(request.url))
    await page.goto(url)
    yield page_tab
    await context.close()
