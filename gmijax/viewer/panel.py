"""The panel of the viewer's page: buttons, sliders, numbers. No jax here.

Callbacks of viser run in threads of its own: they put a request into a queue, and do nothing else.
"""

from __future__ import annotations

import html
import queue
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import viser

from gmijax.viewer import requests
from gmijax.viewer.checkpoints import label
from gmijax.viewer.loop import View
from gmijax.viewer.simulation import Episode, Simulation

SPEEDS: Final[Mapping[str, float]] = {
    "1/8 x": 0.125,
    "1/4 x": 0.25,
    "1/2 x": 0.5,
    "1 x": 1.0,
    "2 x": 2.0,
    "4 x": 4.0,
}

PUSH_M_PER_S: Final = 1.0
"""Change of velocity by a push, before the slider is moved."""

_RUN, _PAUSE, _STEP, _RESET = "Play", "Pause", "Step", "Reset"


class Panel:
    """What can be set and read in the page.

    Args:
      server: viser's.
      asked: where requests are put.
      title: what is shown.
      simulation: of which the terms, commands and number of environments are shown.
      follows_robot: whether there is a robot that the view can follow.
      has_run: whether there are checkpoints to choose from.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        asked: queue.SimpleQueue[requests.Request],
        title: str,
        simulation: Simulation,
        *,
        follows_robot: bool,
        has_run: bool,
    ) -> None:
        self._gui, self._put = server.gui, asked.put
        self._shown: dict[str, Path] = {}
        self._gui.reset()
        self._gui.set_panel_label(title)
        self._state = self._gui.add_html("")
        self._add_run()
        self._add_push()
        if limits := simulation.envs[0].command_limits:
            self._add_command(limits)
        self._checkpoint: Any = None
        if has_run:
            self._add_policy()
        self._env: Any = None
        self._add_environment(len(simulation.envs), follows_robot)
        with self._gui.add_folder("Reward"):
            self._bars = self._gui.add_html("")

    def write(self, simulation: Simulation, view: View) -> None:
        """Shows numbers, and what another client has changed."""
        self._buttons.options = (_RUN if view.paused else _PAUSE, _STEP, _RESET)
        self._set(self._state, "content", state_html(view))
        self._set(self._bars, "content", bars_html(simulation.episodes[view.selected]))
        if self._env is not None:
            self._set(self._env, "value", str(view.selected + 1))
        if self._checkpoint is not None:
            self._write_policy(view)

    def _set(self, handle: Any, name: str, value: Any) -> None:
        # What is the same is not sent again.
        if getattr(handle, name) != value:
            setattr(handle, name, value)

    def _add_run(self) -> None:
        self._buttons = self._gui.add_button_group("Run", (_PAUSE, _STEP, _RESET))
        self._speed = self._gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="1 x")
        acts: dict[str, Callable[[], requests.Request]] = {
            _RUN: lambda: requests.Pause(False),
            _PAUSE: lambda: requests.Pause(True),
            _STEP: requests.StepRequest,
            _RESET: requests.Reset,
        }

        @self._buttons.on_click
        async def _(event: Any) -> None:
            self._put(acts[event.target.value]())

        @self._speed.on_update
        async def _(event: Any) -> None:
            self._put(requests.SetSpeed(SPEEDS[event.target.value]))

    def _add_push(self) -> None:
        button = self._gui.add_button("Push", color="orange", hint="or pull a body: Ctrl and drag")
        strength = self._gui.add_slider(
            "Push (m/s)", min=0.1, max=3.0, step=0.1, initial_value=PUSH_M_PER_S
        )

        @button.on_click
        async def _(_: Any) -> None:
            self._put(requests.Push(strength.value))

    def _add_command(self, limits: Mapping[str, float]) -> None:
        with self._gui.add_folder("Command"):
            drawn = self._gui.add_checkbox("Random", initial_value=True)
            sliders = [
                self._gui.add_slider(
                    _with_unit(name), min=-limit, max=limit, step=limit / 20, initial_value=0.0
                )
                for name, limit in limits.items()
                if limit > 0.0
            ]

        async def send_command(_: Any) -> None:
            values = iter(sliders)
            command = [next(values).value if limit > 0.0 else 0.0 for limit in limits.values()]
            self._put(requests.SetCommand(None if drawn.value else tuple(command)))

        async def take(event: Any) -> None:
            if event.client is not None:  # Moved by a client, not by us.
                drawn.value = False
                await send_command(event)

        drawn.on_update(send_command)
        for slider in sliders:
            slider.on_update(take)

    def _add_policy(self) -> None:
        with self._gui.add_folder("Policy"):
            self._follow = self._gui.add_checkbox("Follow the training", initial_value=False)
            self._checkpoint = self._gui.add_dropdown("Checkpoint", ("-",))

        @self._follow.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                self._put(requests.FollowTraining(event.target.value))

        @self._checkpoint.on_update
        async def _(event: Any) -> None:
            chosen = self._shown.get(event.target.value)
            if event.client is not None and chosen is not None:
                self._put(requests.UseCheckpoint(chosen))

    def _write_policy(self, view: View) -> None:
        # The one that acts may be gone from the disk.
        found = dict.fromkeys((*view.checkpoints, *filter(None, (view.checkpoint,))))
        self._shown = {label(path): path for path in sorted(found, reverse=True)}
        self._set(self._checkpoint, "options", tuple(self._shown) or ("-",))
        if view.checkpoint is not None:
            self._set(self._checkpoint, "value", label(view.checkpoint))
        self._set(self._follow, "value", view.follow_training)

    def _add_environment(self, num_envs: int, follows_robot: bool) -> None:
        if num_envs > 1:
            numbers = tuple(str(number + 1) for number in range(num_envs))
            self._env = self._gui.add_dropdown("Environment", numbers)

            @self._env.on_update
            async def _(event: Any) -> None:
                if event.client is not None:
                    self._put(requests.Select(int(event.target.value) - 1))

        if follows_robot:
            box = self._gui.add_checkbox("Follow the robot", initial_value=True)

            @box.on_update
            async def _(event: Any) -> None:
                self._put(requests.FollowRobot(event.target.value))


def _with_unit(name: str) -> str:
    """The name of a number for people.

    Examples:
      >>> _with_unit("yaw_rad_per_s")
      'yaw (rad/s)'
    """
    for written, unit in (("_rad_per_s", "rad/s"), ("_m_per_s", "m/s")):
        if name.endswith(written):
            return f"{name.removesuffix(written).replace('_', ' ')} ({unit})"
    return name.replace("_", " ")


def state_html(view: View) -> str:
    """A line on how it goes."""
    late = ", as fast as this machine can" if view.is_late else ""
    parts = ["paused" if view.paused else f"{view.rate:.2g} x real time{late}"]
    if view.checkpoint is not None:
        age = "" if view.checkpoint_age_s is None else f", {_age(view.checkpoint_age_s)} old"
        how = "following, " if view.follow_training else ""
        parts.append(f"{how}{label(view.checkpoint)}{age}")
    parts += [view.problem] if view.problem else []
    lines = "<br>".join(html.escape(part) for part in parts)
    return f'<div role="status" style="font-size:0.85em;padding:0 0.5em 0.5em">{lines}</div>'


def _age(seconds: float) -> str:
    for unit, size_s in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size_s:
            return f"{seconds / size_s:.0f} {unit}"
    return f"{seconds:.0f} s"


def bars_html(episode: Episode) -> str:
    """The terms of the reward as bars with a sign: of the last step, and summed."""
    total, now = sum(episode.sums.values()), sum(episode.now.values())
    last = "" if episode.last_return is None else f", previous {episode.last_return:.1f}"
    head = f"episode {episode.number}, step {episode.steps}: return {total:.1f}{last}"
    longest = max((abs(value) for value in episode.now.values()), default=0.0) or 1.0
    rows = [
        _row(name, value, value / longest, episode.sums[name])
        for name, value in episode.now.items()
    ]
    rows.append(_row("sum", now, None, total))
    return (
        f'<div style="font-size:0.85em;padding:0 0.5em 0.5em"><div>{html.escape(head)}</div>'
        '<table style="width:100%;border-collapse:collapse">'
        "<tr><th></th><th>now</th><th></th><th>sum</th></tr>"
        f"{''.join(rows)}</table></div>"
    )


def _row(name: str, now: float, share: float | None, total: float) -> str:
    number = '<td style="text-align:right;font-variant-numeric:tabular-nums">'
    bar = "" if share is None else _bar(share)
    return (
        f"<tr><td>{html.escape(name)}</td>{number}{now:.3f}</td>"
        f'<td style="width:35%">{bar}</td>{number}{total:.1f}</td></tr>'
    )


def _bar(share: float) -> str:
    """From the middle to the right, or to the left for a cost."""
    width = 50.0 * min(abs(share), 1.0)
    left, color = (50.0, "#3c82c8") if share >= 0 else (50.0 - width, "#d2542f")
    return (
        '<div style="position:relative;height:0.8em;background:#8882">'
        f'<div style="position:absolute;left:{left:.1f}%;width:{width:.1f}%;height:100%;'
        f'background:{color}"></div></div>'
    )
