"""Controller of ``--quality auto`` and of the page's budget: chooses settings from measured frame times.

The predicted time of a frame is the cost of its settings times the load. Frames are evaluated in windows, by their
median; a window far above the budget is cut short. Above the budget, settings are chosen anew with the measured load,
to use ``AIM`` of the budget. Below ``LEAST`` of the budget, settings with a smaller error are chosen if they fit into
``AIM``. In between nothing changes. This hysteresis is wider than the noise of a window's median, so that noise causes
no change.

Predicted costs may be too low. If frames exceed the budget right after more expensive settings were applied, those
settings are taken to be the cause, not the load. Settings of that cost are not tried again for some time, which doubles
at each repetition.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping

from warp_ar.accuracy.cost_table import Choice, pareto_front
from warp_ar.accuracy.costs import Costs, make_method_costs

AIM = 0.92
"""Share of the budget for which settings are chosen."""
LEAST = 0.82
"""Share of the budget below which settings with a smaller error are searched for."""
FIRST_WINDOW, WINDOW, LONGEST_WINDOW = 27, 81, 324
"""Frames of the first window, of the first after a change, and of the longest; each window without a change is twice as
long as the last. If frames scatter by a fifth, their medians are known to 5, 3 and 1.4 %."""
HASTE_FRAMES, HASTE = 9, 1.3
"""Least number of frames of a window that is cut short, and the ratio of its median to the budget from which it is."""
HELD_SECONDS = 0.5
"""Least time for which settings are kept."""
SETTLE = 2
"""Frames after a change that are ignored."""
MEMORY = 60.0
"""Seconds for which settings that exceeded the budget are not tried again; doubled at each repetition."""
MOST_DOUBLINGS = 6
"""Largest number of doublings of ``MEMORY``, to about an hour."""


class Controller:
    """Chooses settings for a budget, and changes them by measured frame times."""

    def __init__(
        self,
        costs: Costs,
        errors: Mapping[str, Mapping[str, float]],
        budget_ms: float,
        running: Mapping[str, str] | None = None,
    ) -> None:
        """Choose settings by the costs, or wait for frames that measure the load.

        Args:
            costs: Costs on this device and scene.
            errors: Errors by setting and method.
            budget_ms: Milliseconds per frame.
            running: Settings that run until the load is measured; None: settings are chosen at once.
        """
        self._costs, self._errors, self.budget_ms = costs, errors, budget_ms
        self._front = pareto_front(make_method_costs(costs, errors))
        self._factor: float | None = None
        self._times: list[float] = []
        self._window = WINDOW
        self._skip = SETTLE
        self._held_since = -math.inf
        self._entry_factor: float | None = None
        """Load when the current, more accurate settings were chosen; None after a window has measured their time."""
        self._ceiling, self._until, self._failures = math.inf, 0.0, 0
        """Milliseconds from which settings are not tried until a given time, and the number of such failures."""
        self._never = math.inf
        """Milliseconds from which settings cannot be built."""
        self.chosen = running is None
        """True if the first choice has been made."""
        self.fits = True
        """False if frames exceed the budget and no known settings are cheaper."""
        self.measured_ms: float | None = None
        """Median of the last window, milliseconds."""
        self.settings: dict[str, str] = dict(self._best().settings if running is None else running)
        self._lit = self.settings
        """Settings by which frames were last lit."""

    @property
    def choices(self) -> list[Choice]:
        """All Pareto-optimal choices, cheapest first; milliseconds are relative to the base, as in the costs."""
        return self._front

    @property
    def factor(self) -> float:
        """Ratio of measured to predicted time: the load."""
        return 1.0 if self._factor is None else self._factor

    @property
    def expected_ms(self) -> float:
        """Expected milliseconds per frame of the current settings under the current load."""
        return self.factor * self._cost(self.settings)

    @property
    def expected_error(self) -> float:
        """FLIP in excess of the best methods' that the cost table gives for the current settings."""
        return self._error(self.settings)

    def _error(self, settings: Mapping[str, str]) -> float:
        return sum(self._errors[pair[0]][pair[1]] for pair in settings.items())

    def _cost(self, settings: Mapping[str, str]) -> float:
        """Return the predicted milliseconds of settings, without the load."""
        return max(self._costs.base + self._costs.excess(settings), 1e-3)

    def _best(self) -> Choice:
        """Return the choice of least error within the aim and below the ceiling; the cheapest if none fits."""
        limit = min(AIM * self.budget_ms / self.factor, self._ceiling) - self._costs.base
        never = self._never - self._costs.base
        fitting = [choice for choice in self._front if choice.milliseconds <= limit and choice.milliseconds < never]
        return fitting[-1] if fitting else self._front[0]  # errors decrease along the Pareto front

    def set_budget(self, budget_ms: float) -> None:
        """Choose settings for another budget, with the same load."""
        self.budget_ms, self._ceiling, self._entry_factor = budget_ms, math.inf, None
        self.settings = dict(self._best().settings)
        self.restart()

    def restart(self) -> None:
        """Discard measured frames, if they do not represent the next ones."""
        self._times.clear()
        self._skip, self._window = SETTLE, WINDOW

    def shown(self, now: float) -> None:
        """Note that frames are lit by the current settings from now on."""
        self._held_since, self.chosen, self._lit = now, True, self.settings
        self.restart()

    def reject(self) -> None:
        """Choose cheaper settings because the current ones cannot be built: half-way back to those in use."""
        lit, cost = self._cost(self._lit), self._cost(self.settings)
        self._never, self._entry_factor = (0.5 * (lit + cost) if cost > 1.01 * lit else lit), None
        self.settings = dict(self._best().settings) if self._never > lit else dict(self._lit)
        self.restart()

    def observe(self, milliseconds: float, now: float) -> bool:
        """Take the time of a frame.

        Args:
            milliseconds: Time of the whole frame.
            now: Seconds on a monotonic clock.

        Returns:
            True if ``settings`` changed.
        """
        if self._skip > 0:
            self._skip -= 1
            return False
        self._times.append(milliseconds)
        haste = statistics.median(self._times[-HASTE_FRAMES:]) > HASTE * self.budget_ms
        count = HASTE_FRAMES if haste else self._window if self.chosen and self.fits else FIRST_WINDOW
        if len(self._times) < count or now - self._held_since < HELD_SECONDS:
            return False
        measured = statistics.median(self._times[-count:])
        self._times.clear()
        self.measured_ms = measured
        self._window = min(2 * self._window, LONGEST_WINDOW)
        if now > self._until:
            self._ceiling = math.inf
        over = measured > self.budget_ms
        self._tell_apart(measured, now, over=over)
        best = self._best()
        if self.chosen and not over and (measured >= LEAST * self.budget_ms or best.error >= self.expected_error):
            self.fits = True
            return False
        settings = dict(best.settings)
        cheaper = self._cost(settings) < self._cost(self.settings)
        self.fits = not over or cheaper
        if settings == self.settings or (over and self.chosen and not cheaper):
            self.chosen = True
            return False
        self._entry_factor = self._factor if not cheaper else None
        self.settings, self.chosen, self._held_since = settings, True, now
        self.restart()
        return True

    def _tell_apart(self, measured: float, now: float, *, over: bool) -> None:
        """Attribute the measured time to the load, or to settings that were just applied."""
        entry, self._entry_factor = self._entry_factor, None
        cost = self._cost(self.settings)
        if not over or entry is None:
            self._factor = max(measured, 1e-3) / cost
            return
        self._ceiling = cost * AIM * self.budget_ms / measured
        self._until = now + MEMORY * 2.0**self._failures
        self._failures = min(self._failures + 1, MOST_DOUBLINGS)
