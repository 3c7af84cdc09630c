"""Formats and limits of numbers in options."""

import pytest

from tests.command_line import error, run


@pytest.mark.parametrize("text", ["3_9", "٣", "nan", "inf", "-inf", "0x3", "3,9", "", "1e999"])
def test_text_that_is_no_decimal_number_is_rejected(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    err = error(run(capsys, "board", "/dev/null", f"--divider={text}"))
    assert "--divider" in err
    assert "no decimal number" in err


@pytest.mark.parametrize("text", ["0.5", "200"])
def test_number_outside_its_limits_is_rejected(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    err = error(run(capsys, "board", "/dev/null", "--divider", text))
    assert f"{text}: must be at least 1 and at most 100" in " ".join(err.replace("│", "").split())


@pytest.mark.parametrize(
    "option",
    [
        *("board --aref-v", "board --divider", "board --volts-per-ampere", "capacity --current-offset-std-a"),
        *("capacity --capacity-ah", "demo --seconds", "demo --speed", "identify --soc", "identify --temperature-c"),
        *("ocv --capacity-ah", "ocv --soc", "record --seconds", "replay --soc", "replay --speed"),
        *("simulate --current-a", "simulate --soc", "simulate --noise-lsb", "simulate --speed", "simulate --seconds"),
        *("thesis --resolution-v", "validate --soc"),
    ],
)
def test_every_option_for_a_number_rejects_the_digit_separator_of_python(
    option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "no decimal number" in error(run(capsys, *f"{option}=0_1".split()))


@pytest.mark.parametrize(
    "option",
    [
        *(
            "board --baud",
            "board --serial",
            "demo --port",
            "demo --rate-hz",
            "history --step",
            "ocv --series",
            "ports --baud",
        ),
        *("record --baud", "record --rate-hz", "simulate --series", "simulate --rate-hz", "simulate --seed"),
    ],
)
@pytest.mark.parametrize("text", ["1_200", "٣", "0x3", "3.0", "1e3", ""])
def test_text_that_is_no_integer_is_rejected(option: str, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert "not an integer" in error(run(capsys, *f"{option}={text}".split(" ")))


@pytest.mark.parametrize("text", ["0", "-1", "65536"])
def test_integer_outside_its_limits_is_rejected(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    err = error(run(capsys, "demo", f"--port={text}"))
    assert f"{text}: must be at least 1 and at most 65535" in " ".join(err.replace("│", "").split())
