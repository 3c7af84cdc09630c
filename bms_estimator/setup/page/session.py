"""Steps of the setup on a page: search, choice of the device, comparison with a multimeter, questions, estimates."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

from bms_estimator.model.config_file import without_secrets
from bms_estimator.model.errors import UserError
from bms_estimator.model.payloads.estimate import Estimate
from bms_estimator.service.kernel_warm_up import load_kernels
from bms_estimator.settings.pack import require_new
from bms_estimator.setup.answers import Answers, InvalidAnswerError, parse_number
from bms_estimator.setup.comparison import Comparison
from bms_estimator.setup.first_estimate import run_estimator
from bms_estimator.setup.measurement import Measurement
from bms_estimator.setup.new_pack import NewPack, create_pack
from bms_estimator.setup.questions import QUESTIONS
from bms_estimator.setup.search import SearchResult, default_places, search

ESTIMATE_S = 3600.0
"""Duration of the first estimates [s]. After it, the device is free for other programs, even if the page stays open."""


class Step(Enum):
    """Step that the page shows."""

    SEARCH = "search"
    SEARCHING = "searching"
    DEVICE = "device"
    MULTIMETER = "multimeter"
    PACK = "pack"
    DONE = "done"


@dataclass
class SetupSession:
    """State of the setup of one pack.

    Args:
        file: Settings file to create.
        on_estimate: Called with each estimate of the new pack.
        port: Port of the setup page.

    Attributes:
        step: Step that the page shows.
        error: Reason why the last step failed; empty without a failure.
        places: Places to search.
        result: Result of the last search.
        answers: Answers so far; None before a device is chosen.
        measured: Values of the chosen device.
        comparisons: Results of the comparisons with the multimeter, as text.
        invalid: Reasons why answers were rejected, by name of the question.
        texts: Texts of the answers as entered, by name of the question.
        pack: The new pack; None before its file is written.
    """

    file: Path
    on_estimate: Callable[[Estimate], object]
    port: int = 0
    step: Step = Step.SEARCH
    error: str = ""
    places: Sequence[str] = field(default_factory=default_places)
    result: SearchResult = field(default_factory=SearchResult)
    answers: Answers | None = None
    measured: Measurement | None = None
    comparisons: list[str] = field(default_factory=list)
    invalid: dict[str, str] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)
    pack: NewPack | None = None
    _comparison: Comparison | None = field(default=None, init=False)
    _task: asyncio.Task[None] | None = field(default=None, init=False)

    def start_search(self, places: Sequence[str]) -> None:
        """Search the places in the background. An earlier search, or the estimator, is cancelled."""
        if self._task is not None:
            self._task.cancel()
        self.places, self.step, self.error = places, Step.SEARCHING, ""
        self._task = asyncio.create_task(self._search(), name="search")

    async def _search(self) -> None:
        try:
            self.result = await search(self.places)
            self.step = Step.DEVICE
        except Exception as error:  # noqa: BLE001 - without an end of the search the page would wait for ever
            self.error, self.step = f"the search failed: {type(error).__name__}: {error}", Step.SEARCH

    async def choose_device(self, name: str) -> None:
        """Choose a found device by its name, and measure its values.

        Raises:
            UserError: There is no such device, or no sample arrives.
        """
        devices = {device.name: device for device in self.result.choices}
        if name not in devices:
            raise UserError("choose one of the devices")
        comparison = Comparison(devices[name])
        self.measured = await comparison.measure()
        self._comparison, self.comparisons = comparison, []
        self.answers = Answers(devices[name], self.measured, name=self.file.stem, found_broker=self.result.broker)
        self.step = Step.MULTIMETER

    async def compare(self, quantity: str, text: str) -> None:
        """Compare a quantity with the multimeter: ``voltage``, ``zero``, ``current`` or ``direction``.

        Raises:
            InvalidAnswerError: The value is malformed or implausible.
            UserError: The device does not answer.
        """
        if self._comparison is None:
            return
        match quantity:
            case "voltage":
                result = await self._comparison.compare_voltage(parse_number(text, "V"))
            case "current":
                result = await self._comparison.compare_current(parse_number(text, "A"))
            case "direction":
                result = await self._comparison.compare_direction(text)
            case _:
                result = await self._comparison.set_zero()
        self.comparisons.append(result)

    async def finish_comparison(self) -> None:
        """Store the gains on a board, and continue with the questions.

        Raises:
            UserError: The board does not answer, or rejects a gain.
        """
        if self._comparison is None or self.answers is None:
            return
        self.answers = replace(self.answers, sensor=await self._comparison.finish())
        self.step = Step.PACK

    async def create(self, texts: Mapping[str, str]) -> None:
        """Write the settings file from the texts of all answers, and start the estimator.

        An empty text is replaced by the default. If an answer is invalid, its reason is stored and nothing is written.

        Raises:
            UserError: A setting is invalid, or the file exists or cannot be written.
        """
        if self.answers is None:
            return
        self.invalid, answers = {}, self.answers
        self.texts = {name: without_secrets(text) for name, text in texts.items()}
        for question in filter(lambda each: each.is_asked(answers), QUESTIONS):
            text = texts.get(question.name, "").strip() or question.suggest(answers)
            try:
                answers = question.answer(text, answers)
            except InvalidAnswerError as error:
                self.invalid[question.name] = str(error) if text else "missing"
        if self.invalid:
            return
        require_new(self.file)
        self.pack = create_pack(self.file, answers, self.port)
        self.step = Step.DONE
        self._task = asyncio.create_task(self._estimate(self.pack), name="first estimate")

    async def _estimate(self, pack: NewPack) -> None:
        try:
            await asyncio.to_thread(load_kernels)
            await run_estimator(pack.settings, pack.cell, self.on_estimate, seconds=ESTIMATE_S)
        except Exception as error:  # noqa: BLE001 - the page reports it
            self.error = str(error)

    async def close(self) -> None:
        """End the search or the estimator."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
