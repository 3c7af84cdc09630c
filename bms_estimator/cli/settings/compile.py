"""``bms-estimator compile``: compilation of the kernels ahead of the first start."""

import typer

from bms_estimator.cli.options.progress_bar import compile_ahead
from bms_estimator.model.errors import UserError
from bms_estimator.numba_cache import CACHE_FOLDER, SHIPPED_FOLDER
from bms_estimator.service.kernel_compilation import COMPLETE_FILE


def compile_command() -> None:
    """Compile the kernels before the first start.

    The compiled kernels are stored in $NUMBA_CACHE_DIR, or without this variable in your cache folder. The service uses
    /var/cache/bms-estimator. Debian package and Docker images are built with kernels in the folder `compiled` of the program.
    """
    if CACHE_FOLDER is None:
        raise UserError("no folder for compiled kernels can be written: set NUMBA_CACHE_DIR=FOLDER")
    compile_ahead()
    typer.echo(f"compiled kernels: {SHIPPED_FOLDER if (SHIPPED_FOLDER / COMPLETE_FILE).exists() else CACHE_FOLDER}")
