"""The camera of a run: estimated, by a field of view that is typed, or a calibration, which can be sent."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scopemap.apps.browser.looking import Look, holds_camera
from scopemap.apps.browser.window import typed_number
from scopemap.apps.browser.workspace import Workspace
from scopemap.engine.errors import ScopemapError, SettingsError

if TYPE_CHECKING:
    from scopemap.apps.browser.window import BrowserWindow

_ESTIMATED = "estimated from the video"
_BY_FOV = "by its field of view"


class CameraPart:
    """Controls of the camera.

    chosen : the calibration that the look advises. changed : called with what changes of the choice of a run.
    """

    def __init__(
        self,
        window: BrowserWindow,
        workspace: Workspace,
        found: Look,
        chosen: Path | None,
        changed: Callable[[dict[str, Any]], None],
    ) -> None:
        self._window, self._size, self._changed, gui = window, found.spread.size, changed, window.gui
        self._receiver = workspace.receiver(window.server, "calibration")
        # What came while no such page was open is in the list, where it fits.
        while self._receiver.take() is not None:
            pass
        sent = [file for file in workspace.sent_calibrations if holds_camera(file, self._size)]
        self._listed = [*found.calibrations, *found.refused, *sent]
        files = self._files
        self._label = next((label for label, file in files.items() if file == chosen), _ESTIMATED)
        camera = gui.add_dropdown("Camera", (_ESTIMATED, _BY_FOV, *files), initial_value=self._label)
        self._camera = window.on(camera, self._choose)
        self._fov = gui.add_text("Field of view, degrees", "", visible=False, hint="Horizontal, such as 90.")
        window.on(self._fov, lambda text: self._show_fov() if self._fov.visible else None)
        self._receiver.button(gui, "Send a calibration").color = "gray"

    def tick(self) -> None:
        """Choose a calibration that has come, or say what is wrong with it."""
        if (refused := self._receiver.take_refusal()) is not None:
            name, reason = self._window.names.of(Path(refused[0]), "calibration"), refused[1]
            self._window.fail(f"{name} was not taken: {reason}")
        if (sent := self._receiver.take()) is None:
            return
        self._window.names.of(sent, "calibration")  # before what is wrong is said: it may be hidden
        try:
            self._read(sent)
        except ScopemapError:
            sent.unlink(missing_ok=True)
            raise
        self._listed.append(sent)
        self._camera.options = (_ESTIMATED, _BY_FOV, *self._files)
        label = next(label for label, file in self._files.items() if file == sent)
        self._camera.value = label
        self._take(label, sent)

    @property
    def _files(self) -> dict[str, Path]:
        return self._window.names.labelled(self._listed, "calibration")

    def _read(self, file: Path) -> None:
        """Read a calibration; raises `CalibrationError` where it holds no camera for these pictures."""
        from scopemap.input.camera_files.reading import read_calibration

        read_calibration(file, self._size)

    def _choose(self, label: str) -> None:
        file = self._files.get(label)
        try:
            # What a browser sends need not be of the list.
            if file is None and label not in (_ESTIMATED, _BY_FOV):
                raise SettingsError("choose one of the list")
            if file is not None:
                self._read(file)
        except ScopemapError:
            self._camera.value = self._label
            raise
        self._take(label, file)

    def _take(self, label: str, file: Path | None) -> None:
        self._label, self._fov.visible = label, label == _BY_FOV
        if self._fov.visible:
            self._show_fov()
        else:
            self._changed({"camera": file, "fov_deg": None})

    def _show_fov(self) -> None:
        self._changed({"camera": None, "fov_deg": typed_number(self._fov.value)})
