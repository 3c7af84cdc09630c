"""Screenshots of reports for the documentation (``make screenshots``): desktop, phone and paper."""

import asyncio
import subprocess
import sys
import tempfile
from pathlib import Path

from playwright.async_api import Browser

from tests.command_line import PROGRAM
from tests.page.chromium import PHONE, chromium, tab

ROOT = Path(__file__).parents[2]
CAPTURE = ROOT / "tests" / "data" / "leaf" / "hppc_25c_from_full.csv.gz"
"""Capture of a Nissan Leaf's cell: pulses and rests from full to empty."""
PAPER = {"width": 688, "height": 1017}
"""A4 without the margins of the style sheet, at 96 dpi [px]."""
HEIGHT_PX = {"desktop": 1500, "phone": 1800, "print": 1017}
"""Height of the part of the page that each picture shows [px]."""


def make_report(folder: Path) -> Path:
    """Return the report on ``CAPTURE``."""
    out = folder / "report.html"
    subprocess.run([PROGRAM, "report", CAPTURE, "--cell", "leaf", "--out", out], check=True, stdout=subprocess.DEVNULL)
    return out


async def take_screenshots(browser: Browser, report: Path, folder: Path) -> list[Path]:
    """Write the upper part of the report as it is on a desktop, a phone and paper. Return the paths."""
    sizes = {"desktop": {"width": 1280, "height": 800}, "phone": PHONE, "print": PAPER}
    paths = []
    for name, size in sizes.items():
        async with tab(
            browser, report.as_uri(), size=size, device_scale_factor=1.5 if name == "phone" else 1
        ) as page_tab:
            if name == "print":
                await page_tab.page.emulate_media(media="print")
            paths.append(folder / f"report-{name}.png")
            clip = {"x": 0, "y": 0, "width": size["width"], "height": HEIGHT_PX[name]}
            await page_tab.page.screenshot(path=paths[-1], full_page=True, clip=clip)
    return paths


async def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        report = make_report(Path(folder))
        async with chromium() as browser:
            for path in await take_screenshots(browser, report, ROOT / "docs" / "images"):
                sys.stdout.write(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1e3:.0f} kB\n")


if __name__ == "__main__":
    asyncio.run(main())
