"""Self-contained HTML pages from the Jinja2 templates in ``templates``, without scripts and external resources."""

from bms_estimator.version import __version__


def render(template: str, **values: object) -> str:
    """Return a page.

    Args:
        template: File name in ``templates``.
        **values: Values of the template. Their texts are escaped, except SVG, which the templates mark as safe.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined  # noqa: PLC0415 - optional

    environment = Environment(
        loader=PackageLoader("bms_estimator.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(version=__version__, **values)
