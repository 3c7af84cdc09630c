"""HTML of the setup page. Every step is a form that works without a script."""

import shlex
from collections.abc import Iterable
from html import escape

from bms_estimator.installation.machine import root_command
from bms_estimator.model.config_file import without_secrets
from bms_estimator.setup.broker_login import BrokerLogin
from bms_estimator.setup.first_estimate import current_note
from bms_estimator.setup.multimeter import CHARGING, DISCHARGING
from bms_estimator.setup.new_pack import run_command
from bms_estimator.setup.page.session import SetupSession, Step
from bms_estimator.setup.questions import QUESTIONS, Question
from bms_estimator.setup.search import missing_packages
from bms_estimator.telemetry.state import UNKNOWN_SOC

TITLES = {
    Step.SEARCH: "Search",
    Step.SEARCHING: "Search",
    Step.DEVICE: "Device",
    Step.MULTIMETER: "Multimeter",
    Step.PACK: "Pack",
    Step.DONE: "First estimate",
}
"""Title of each step."""
REFRESH_S = 2
"""Interval at which the page is loaded again while the search runs [s]."""
KEY_FIELD = "form_key"
"""Name of the hidden field with the key of the forms."""


def page(session: SetupSession, form_key: str) -> str:
    """Return the page of the present step.

    Args:
        session: State of the setup.
        form_key: Key that every form contains, so that no other web site can send a form.
    """
    refresh = f'<meta http-equiv="refresh" content="{REFRESH_S}">' if session.step is Step.SEARCHING else ""
    steps = "".join(
        f"<li{' aria-current=step' if title == TITLES[session.step] else ''}>{title}</li>"
        for title in dict.fromkeys(TITLES.values())
    )
    error = f'<p id="why" role="alert">{escape(session.error)}</p>' if session.error else ""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">{refresh}<title>Set up a pack - bms_estimator</title>
<link rel="icon" href="icon.svg"><link rel="stylesheet" href="style.css"><link rel="stylesheet" href="setup.css">
<script type="module" src="setup.js"></script></head>
<body class="setup"><header><img src="icon.svg" alt="" width="30" height="30"><div class="who"><h1>Set up a pack</h1>
<p id="what">{escape(str(session.file))}</p></div></header>
<ol class="steps">{steps}</ol>{error}<main>{_BODIES[session.step](session, form_key)}</main></body></html>"""


def _form(action: str, form_key: str, content: str, button: str, *, secondary: bool = False) -> str:
    css_class = ' class="secondary"' if secondary else ""
    return (
        f'<form method="post" action="{action}"><input type="hidden" name="{KEY_FIELD}" value="{form_key}">'
        f"{content}<button{css_class}>{button}</button></form>"
    )


def _search(session: SetupSession, form_key: str) -> str:
    places = escape("\n".join(map(without_secrets, session.places)))
    content = (
        '<label>Where to search<textarea name="places" rows="4">' + places + "</textarea></label>"
        '<p class="note">One place per line: path of a serial port, URL of an MQTT broker (mqtt://user:password@host), host name of a '
        "Modbus device, or bluetooth. A serial port takes up to 20 s."
        + "".join(
            f" {kind} needs a missing package: {escape(command)}." for kind, command in missing_packages().items()
        )
        + "</p>"
    )
    button = "Search again" if session.step is Step.DEVICE or session.error else "Search"
    return f'<section class="card">{_form("search", form_key, content, button, secondary=bool(session.result.devices))}</section>'


def _searching(session: SetupSession, _: str) -> str:
    return (
        '<section class="card"><h2>Searching</h2>'
        f"<ul>{_items(map(without_secrets, session.places))}</ul><p class='note'>This takes up to 20 s.</p></section>"
    )


def _device(session: SetupSession, form_key: str) -> str:
    devices = "".join(
        f'<label class="choice"><input type="radio" name="device" value="{escape(device.name)}"'
        f"{' checked' if len(session.result.choices) == 1 else ''} required>"
        f"<span><b>{escape(device.name)}</b> {escape(str(device))}</span></label>"
        for device in session.result.choices
    )
    form = _form("device", form_key, devices, "Use this device") if devices else "<p>No device was found.</p>"
    failures = f'<ul class="note">{_items(session.result.failures)}</ul>' if session.result.failures else ""
    logins = "".join(_login(login, form_key) for login in session.result.login_required)
    return f'<section class="card"><h2>Found</h2>{form}{failures}</section>{logins}{_search(session, form_key)}'


def _login(login: BrokerLogin, form_key: str) -> str:
    """Return the form with the user name and the password for a broker, which is then searched again."""
    url = escape(login.url)
    fields = (
        f'<input type="hidden" name="url" value="{url}">'
        '<label>User name<input name="username" autocomplete="off" required></label>'
        '<label>Password<input name="password" type="password" autocomplete="off" required></label>'
    )
    return f'<section class="card"><h2>Log in at {url}</h2>{_form("login", form_key, fields, "Log in")}</section>'


def _multimeter(session: SetupSession, form_key: str) -> str:
    values, _, reported = str(session.measured).partition("; ")
    results = f"<ul>{_items(session.comparisons)}</ul>" if session.comparisons else ""
    voltage = _number_field("value", "Voltage at the terminals of the pack by the multimeter [V]")
    current = _number_field("value", "Current of a load by the multimeter [A], negative while the pack is charged")
    direction = (
        '<label>Or without a multimeter: the pack is now<select name="value">'
        f"<option>{DISCHARGING}</option><option>{CHARGING}</option></select></label>"
    )
    return (
        f'<section class="card"><h2>Measured by the device</h2><p class="big">{escape(values)}</p><p>{escape(reported)}</p>'
        f"{results}{_form('continue', form_key, '', 'Continue')}</section>"
        '<section class="card"><h2>Compare with a multimeter</h2><p class="note">Each comparison may be left out. '
        "A second voltage at another state of charge makes the gain more exact.</p>"
        f"{_form('compare/voltage', form_key, voltage, 'Compare voltage', secondary=True)}"
        f"{_form('compare/zero', form_key, '<p>Switch off all loads and chargers.</p>', 'Set the zero', secondary=True)}"
        f"{_form('compare/current', form_key, current, 'Compare current', secondary=True)}"
        f"{_form('compare/direction', form_key, direction, 'Check the sign', secondary=True)}</section>"
    )


def _pack(session: SetupSession, form_key: str) -> str:
    answers = session.answers
    fields = "".join(_question(session, each) for each in QUESTIONS if answers and each.is_asked(answers))
    return f'<section class="card">{_form("pack", form_key, fields, "Write the settings file")}</section>'


def _done(session: SetupSession, _: str) -> str:
    if session.pack is None:
        return ""
    warnings = f"<ul class='bad'>{_items(session.pack.warnings)}</ul>" if session.pack.warnings else ""
    install, run = escape(shlex.join(root_command("install", session.file))), escape(run_command(session.file))
    capacity_ah = session.pack.cell.cell.capacity_ah
    note = current_note(session.measured.current_a, capacity_ah) if session.measured else ""
    return (
        '<section class="card"><h2>State of charge</h2><div id="known"><p class="huge"><b data-q="soc">&nbsp;</b>'
        '<small>%</small></p><p class="band">± <b data-q="band">&nbsp;</b> %</p><p class="note">two standard deviations</p></div>'
        f'<div id="unknown" hidden><p class="unknown">not known yet</p><p>{UNKNOWN_SOC.partition(": ")[2].capitalize()}.</p></div>'
        '<p id="wait" role="status">Waiting for the first estimate. The first start compiles the kernels, which takes a '
        'minute or two.</p><p>measured <b data-q="voltage"></b> V, <b data-q="current"></b> A</p>'
        f'<p class="note">{note}</p></section>'
        f'<section class="card"><h2>{escape(str(session.file))} is written</h2><p>{escape(session.pack.summary)}</p>'
        f"{warnings}<p>End this program, then run the estimator here:</p><pre>{run}</pre>"
        f"<p>or install the service:</p><pre>{install}</pre></section>"
    )


_BODIES = {
    Step.SEARCH: _search,
    Step.SEARCHING: _searching,
    Step.DEVICE: _device,
    Step.MULTIMETER: _multimeter,
    Step.PACK: _pack,
    Step.DONE: _done,
}


def _question(session: SetupSession, question: Question) -> str:
    """Return the field of a question. It contains the entered text, otherwise the default."""
    default = question.suggest(session.answers) if session.answers else ""
    entered = session.texts.get(question.name, default)
    reason = session.invalid.get(question.name)
    error = f'<span class="bad" role="alert">{escape(reason)}</span>' if reason else ""
    explanation = f'<span class="note">{escape(question.explanation)}</span>' if question.explanation else ""
    if question.choices:
        options = "".join(
            f'<option value="{name}"{" selected" if name == entered else ""}>{escape(text)}</option>'
            for name, text in question.choices
        )
        control = f'<select name="{question.name}" required><option value=""></option>{options}</select>'
    else:
        control = f'<input name="{question.name}" value="{escape(entered)}" placeholder="{"" if default else question.hint}" autocomplete="off">'
    return f"<label>{escape(question.text)}{explanation}{control}{error}</label>"


def _number_field(name: str, text: str) -> str:
    return f'<label>{text}<input name="{name}" inputmode="decimal" autocomplete="off" required></label>'


def _items(texts: Iterable[str]) -> str:
    return "".join(f"<li>{escape(text)}</li>" for text in texts)
