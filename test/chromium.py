"""The browser that tests of pages drive: Debian's or another Chromium, without a window."""

import shutil

BROWSER_OPTIONS = (
    '--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader',
)  # fmt: skip
"""Without window and graphics card, in a container too."""
NAMES = ('chromium', 'chromium-browser', 'google-chrome')


def browser_of() -> str | None:
    """The path of a browser, None where there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)
