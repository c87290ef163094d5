"""Record the terminal of a run, and measure how long lines of the live table do not change.

    python benchmarks/standing_lines.py -o terminal.txt --most 2 -- orthoflow run quickstart.yaml

prints, for each step, its duration, the longest time in which its line did not change, and the end
of that time; and the same for the whole screen, from the start of the command. The exit code is 1
if a line did not change for longer than `--most` seconds, or if the command failed. The recording
contains a frame for each change, with its time in seconds.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time
from dataclasses import dataclass, field
from pathlib import Path

_ROWS, _COLUMNS = 40, 120
_SEQUENCE = re.compile(r"\x1b\[([0-9;?]*)([A-Za-z])")


@dataclass
class Screen:
    """The subset of a terminal that rich uses: text, line ends, cursor up, clearing lines."""

    lines: list[str] = field(default_factory=lambda: [""])
    row: int = 0
    column: int = 0

    def feed(self, text: str) -> None:
        """Process the output of a program."""
        place = 0
        while place < len(text):
            found = _SEQUENCE.match(text, place)
            if found:
                self._obey(found[1], found[2])
                place = found.end()
                continue
            letter = text[place]
            place += 1
            if letter == "\n":
                self.row += 1
                self.column = 0
                if self.row == len(self.lines):
                    self.lines.append("")
            elif letter == "\r":
                self.column = 0
            elif letter >= " ":
                line = self.lines[self.row].ljust(self.column)
                self.lines[self.row] = line[: self.column] + letter + line[self.column + 1 :]
                self.column += 1

    def _obey(self, number: str, letter: str) -> None:
        if letter == "A":
            self.row = max(0, self.row - int(number or 1))
        elif letter == "K":
            self.lines[self.row] = "" if number == "2" else self.lines[self.row][: self.column]

    def text(self) -> tuple[str, ...]:
        """Return as many of the last lines as fit."""
        return tuple(line.rstrip() for line in self.lines[-_ROWS:])


@dataclass
class Stillness:
    """The time during which content was observed, and the longest time without a change."""

    began_s: float
    changed_s: float
    ended_s: float
    content: str
    longest_s: float = 0.0
    longest_until_s: float = 0.0

    def see(self, content: str, now_s: float) -> None:
        """Observe the content again."""
        if now_s - self.changed_s > self.longest_s:
            self.longest_s, self.longest_until_s = now_s - self.changed_s, now_s
        self.ended_s = now_s
        if content != self.content:
            self.content, self.changed_s = content, now_s


def record(command: list[str], frames: Path | None) -> tuple[dict[str, Stillness], int]:
    """Run a command in a terminal; observe the lines of running steps and the whole screen.

    Returns:
        The observations by line, and the exit code.
    """
    controlling, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", _ROWS, _COLUMNS, 0, 0))
    started = time.monotonic()
    process = subprocess.Popen(
        command,
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        env={**os.environ, "TERM": "xterm", "COLUMNS": str(_COLUMNS), "LINES": str(_ROWS)},
    )
    os.close(terminal)
    screen, watched, earlier = Screen(), {}, ()
    out = frames.open("w", encoding="utf-8") if frames else None
    while True:
        ready, _, _ = select.select([controlling], [], [], 0.1)
        now_s = time.monotonic() - started
        if ready:
            try:
                block = os.read(controlling, 1 << 16)
            except OSError:
                break
            if not block:
                break
            screen.feed(block.decode("utf-8", errors="replace"))
        shown = screen.text()
        _watch(watched, shown, now_s)
        if out and shown != earlier:
            print(f"--- {now_s:.2f} s", *shown, sep="\n", file=out)
        earlier = shown
    code = process.wait()
    if out:
        out.close()
    return watched, code


def _watch(watched: dict[str, Stillness], shown: tuple[str, ...], now_s: float) -> None:
    running = {line.split()[0]: line for line in shown if re.search(r"^\S+ +\d+ %", line)}
    for name, content in {**running, "(the whole)": "\n".join(shown)}.items():
        first = Stillness(began_s=now_s, changed_s=now_s, ended_s=now_s, content=content)
        watched.setdefault(name, first).see(content, now_s)


def main() -> None:
    """Record and print the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, help="file for the frames")
    parser.add_argument("--most", type=float, default=float("inf"), help="seconds")
    parser.add_argument("command", nargs="+")
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    watched, code = record(arguments.command, arguments.output)
    for name, item in watched.items():
        seconds = item.ended_s - item.began_s
        still = f"at most {item.longest_s:4.1f} s still, until {item.longest_until_s:.1f} s"
        sys.stdout.write(f"{name:20s} {seconds:7.1f} s, {still}\n")
    sys.stdout.write(f"load before {load:.1f}, after {os.getloadavg()[0]:.1f}\n")
    stood = any(item.longest_s > arguments.most for item in watched.values())
    sys.exit(1 if stood or code else 0)


if __name__ == "__main__":
    main()
