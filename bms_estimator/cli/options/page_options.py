"""Options of commands that serve a page."""

from typing import Any

from pydantic import ValidationError

from bms_estimator.model.errors import UserError
from bms_estimator.settings.page import PageSettings


def page_settings(settings: PageSettings, **given: Any) -> PageSettings:
    """With what the command line says.

    Raises:
        UserError: It cannot be.
    """
    told = {name: value for name, value in given.items() if value is not None}
    try:
        return PageSettings.model_validate(settings.model_dump() | told)
    except ValidationError as error:
        reason = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise UserError(f"--listen {told.get('listen', settings.listen)}: {reason}") from None
