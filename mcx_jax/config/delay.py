"""Actuation delays: names, parsing and group delay.

A delay is named on the command line (`--delay`); `mcx_jax.arm.lag` is what it does.
"""

import math
import re
from dataclasses import dataclass

from mcx_jax.errors import UserError

PHYSICS_DT_S = 0.002
"""Physics step: 500 Hz (paper; authors' code)."""
SUBSTEPS = 10
"""Physics steps per control step."""
CONTROL_DT_S = PHYSICS_DT_S * SUBSTEPS
"""Control step: 50 Hz (paper; authors' code)."""
NYQUIST_HZ = 0.5 / CONTROL_DT_S

MAX_DELAY_S = 1.0
"""Longest delay accepted: evaluation looks that far ahead, and slower filters drift in float32."""

NAMED_DELAYS = {
    "E0": "explicit:0",
    "E1": "explicit:1",
    "E2": "explicit:2",
    "B4_21": "butter:4:20.8Hz",
    "B4_4": "butter:4:10.4Hz",
}
"""The five delays of the paper's table 2. "B(4,4)" is an erratum of the paper: 4 Hz would delay by
102 ms; the authors' code has 0.416 of Nyquist = 10.4 Hz, 34 ms, and only that fits table 3."""


@dataclass(frozen=True)
class Delay:
    """How late the arm answers: a queue of control steps, or a low-pass filter, on the joint
    references (paper section 3, table 2)."""

    name: str
    steps: int = 0
    """Explicit delay k in control steps of 20 ms."""
    order: int = 0
    """Order of the Butterworth filter; 0 = no filter."""
    cutoff_hz: float = 0.0
    """-3 dB frequency of the Butterworth filter."""

    @property
    def group_delay_s(self) -> float:
        """Delay of a slow motion, seconds: k * 20 ms, or the filter's group delay at 0 Hz."""
        return self.steps * CONTROL_DT_S + _butter_dc_group_delay_s(self.order, self.cutoff_hz)

    def describe(self) -> str:
        """One line with the true cutoff and delay, printed whenever a delay is named."""
        if self.order:
            return (
                f"{self.name}: Butterworth order {self.order}, cutoff {self.cutoff_hz:g} Hz, "
                f"group delay {1e3 * self.group_delay_s:.1f} ms at 0 Hz"
            )
        milliseconds = 1e3 * self.group_delay_s
        return f"{self.name}: explicit delay of {self.steps} control steps = {milliseconds:.0f} ms"


def _butter_dc_group_delay_s(order: int, cutoff_hz: float) -> float:
    """Group delay at 0 Hz of the bilinear-transformed Butterworth low-pass.

    An analogue pole pair contributes sin(theta)/w_c each, summing to 1/(w_c) * sum over poles of
    Re(-1/p); the bilinear map with prewarping has w_c = (2/T) tan(pi f_c T) and dw/dW = 1 at 0.
    """
    if order == 0:
        return 0.0
    wc = 2.0 / CONTROL_DT_S * math.tan(math.pi * cutoff_hz * CONTROL_DT_S)
    angles = [math.pi * (2 * k + 1) / (2 * order) for k in range(order)]
    return sum(math.sin(angle) for angle in angles) / wc


def parse_delay(text: str) -> Delay:
    """Read `E3`, `B4_4`, `B4_21` or a literal `butter:ORDER:CUTOFFHz`.

    Raises:
        UserError: unknown form, cutoff at or above Nyquist (25 Hz), order or steps out of range.
    """
    literal = NAMED_DELAYS.get(text, text)
    if match := re.fullmatch(r"(?:explicit:|E)([0-9]{1,9})", literal):
        steps = int(match[1])
        if steps > 50:
            raise UserError(f"--delay {text}: at most 50 control steps (1 s), e.g. E5")
        return Delay(name=text, steps=steps)
    if match := re.fullmatch(r"butter:([0-9]{1,9}):([0-9]+(?:\.[0-9]+)?)(?:Hz)?", literal):
        order, cutoff_hz = int(match[1]), float(match[2])
        if not 1 <= order <= 12:
            raise UserError(f"--delay {text}: the filter order must be 1 to 12")
        if not 0.1 <= cutoff_hz < NYQUIST_HZ:
            raise UserError(
                f"--delay {text}: the cutoff must be at least 0.1 Hz and below the Nyquist "
                f"frequency {NYQUIST_HZ:g} Hz (control runs at 50 Hz)"
            )
        delay = Delay(name=text, order=order, cutoff_hz=cutoff_hz)
        if delay.group_delay_s > MAX_DELAY_S:
            raise UserError(
                f"--delay {text}: delays by {delay.group_delay_s:.1f} s; at most {MAX_DELAY_S:g} "
                "s: raise the cutoff or lower the order"
            )
        return delay
    raise UserError(
        f"unknown delay '{text}': use one of {', '.join(NAMED_DELAYS)}, E<k> for k control steps, "
        "or butter:<order>:<cutoff>Hz, e.g. butter:4:7.5Hz"
    )
