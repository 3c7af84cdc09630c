import pytest

from bms_estimator.model.cell import load_cell
from bms_estimator.reports.thesis.bank_figure import WEAK_SOC, BankExperiment


@pytest.fixture(scope="module")
def bank() -> BankExperiment:
    return BankExperiment(load_cell("chen_mora"))


def test_dips_of_figure_43_are_located_where_the_weak_batteries_are_empty(bank: BankExperiment) -> None:
    assert bank.dips == pytest.approx(sorted(WEAK_SOC), abs=0.03)


def test_warning_of_figure_43_comes_before_the_first_dip(bank: BankExperiment) -> None:
    assert bank.drawn_at_warning < bank.dips[0] - 0.2
