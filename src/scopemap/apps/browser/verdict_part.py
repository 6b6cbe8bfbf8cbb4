"""The verdict on a result and its reasons, with the runs that would mend them as buttons."""

from __future__ import annotations

from collections.abc import Callable

from scopemap.apps.browser.next_steps import NextRun, next_runs, source_of
from scopemap.apps.browser.shown_result import ShownResult
from scopemap.apps.browser.window import escaped, typed_number
from scopemap.engine.notices import Level
from scopemap.report.plain_step import plain_step
from scopemap.result.summary import summary_facts
from scopemap.result.verdict import Reason, verdict

_NAMES: dict[Level, str] = {"bad": "Not usable", "doubtful": "Caution", "note": "Note"}
_GOOD = "The surface agrees with its own video. Its true shape was not measured."
_MOST_BUTTONS = 3
_CHOOSE = "choose"


class VerdictPart:
    """The facts, the cautions and the notes; `again` is called with an option and its value where one is chosen."""

    def __init__(self, shown: ShownResult, again: Callable[[NextRun, str], None]) -> None:
        self._shown, self._again = shown, again
        gui, found = shown.window.gui, verdict(shown.whole)
        self._can_run = shown.workspace is not None and source_of(shown.whole) is not None
        if found.level == "good":
            gui.add_markdown(_GOOD)
        for reason in found.reasons:
            if reason.level in ("bad", "doubtful"):
                self._add(reason)
        notes = [reason for reason in found.reasons if reason.level == "note"]
        if notes:
            with gui.add_folder("Notes", expand_by_default=False):
                for reason in notes:
                    self._add(reason)
        good = [reason for reason in found.reasons if reason.level == "good"]
        if good:
            gui.add_markdown("\n".join(f"- {escaped(reason.text)}" for reason in good))
        if self._can_run:
            self._improve(found.reasons)
        with gui.add_folder("Details", expand_by_default=False):
            facts = summary_facts(shown.whole).items()
            gui.add_markdown("\n".join(f"- **{name}**: {escaped(fact)}" for name, fact in facts))

    def _add(self, reason: Reason) -> None:
        words = " ".join(filter(None, (reason.text, plain_step(reason.next_step))))
        self._shown.window.gui.add_markdown(f"**{_NAMES[reason.level]}.** {escaped(words)}")

    def _improve(self, reasons: list[Reason]) -> None:
        """Offer the runs that the reasons name, each option once."""
        runs = [run for reason in reasons for run in next_runs(reason.next_step, self._shown.whole)]
        offered = {(run.option, run.choices): run for run in runs}
        if offered:
            with self._shown.window.gui.add_folder("Improve this result"):
                for run in offered.values():
                    self._offer(run)

    def _offer(self, run: NextRun) -> None:
        gui, window = self._shown.window.gui, self._shown.window
        if run.number is not None:
            number = gui.add_text(run.question, "")
            window.on(gui.add_button(run.label()), lambda: self._again_with(run, number.value))
        elif len(run.choices) > _MOST_BUTTONS:
            # Without a statement none is preset: a wrong one makes the result worse, and takes the caution away.
            preset = run.stated if run.stated in run.choices else _CHOOSE
            choice = gui.add_dropdown(run.question, (_CHOOSE, *run.choices), initial_value=preset)
            window.on(gui.add_button(run.label()), lambda: self._again_chosen(run, choice.value))
        else:
            for value in run.choices:
                window.on(gui.add_button(run.label(value)), self._again, run, value)

    def _again_chosen(self, run: NextRun, value: str) -> None:
        """Start the run with what was chosen, if something was."""
        if value == _CHOOSE:
            self._shown.note(f"{run.question} Choose one first.")
        elif value == run.stated:
            self._shown.note(f"This result was run as: {value}. Choose another endoscope first.")
        else:
            self._again(run, value)

    def _again_with(self, run: NextRun, typed: str) -> None:
        """Start the run with the number that was typed, if it is one that can be."""
        assert run.number is not None
        low, high = run.number
        value = typed_number(typed)
        if low <= value <= high:
            self._again(run, f"{value:g}")
        else:
            self._shown.note(f"{run.question}: type a number from {low:g} to {high:g} first.")
