"""The recorder: reads a device and writes a log, in a process of its own (process.py).

Whatever ends it (the count, Ctrl-C, a limit, a full disk, a silent device), the drive is brought to zero and the log gets its
last word; after kill -9 the device's watchdog does the first.
"""

import contextlib
import json
import time

import numpy as np

from ..errors import ConfigurationError, DeviceError
from . import protocol as p
from .adapters import BinaryAdapter, ScpiAmplifier, TextAdapter
from .dialogue import command, demagnetize, end_foreign_run
from .framing import encode
from .link import LINK_ERRORS, READ, ask_hello, candidates, open_port, quick_read, shut, try_device
from .log import DiskFull, LogWriter, free_room
from .order import Order
from .tracker import Tracker

FLUSH, TELL = 0.05, 0.2  # s


class Ended(Exception):
    """Why the recording ends, with the exit status."""

    def __init__(self, reason: str, status: int):
        super().__init__(reason)
        self.reason, self.status = reason, status


class Recorder:
    """One recording by an `Order`; `tell(dict)` gets progress; `stop` (set from a signal) ends it in order."""

    def __init__(self, order: Order, tell):
        self.order, self.tell = order, tell
        self.stop = None
        self.adapter = TextAdapter(order.text or None) if order.text is not None else BinaryAdapter()
        self.log = self.port = self.hello = self.tracker = self.final = self.amplifier = None
        self.segment, self.attempts = -1, 0
        self.pending, self.pending_at = [], None
        self.totals = {"received": 0, "lost": 0, "repeats": 0, "sent": 0, "dropped_by_device": 0, "tail_known": True}
        self.acknowledged, self.waiting = 0, []
        self.loop, self.patience, self.saved = None, 0.0, 0  # `saved`: samples of this segment in the log

    # the course of a recording

    def run(self) -> dict:
        """Record; returns the summary, which is also the log's last chunk. Raises `MagjaxError` before anything was recorded."""
        order = self.order
        self._connect()
        self.check_stop()
        order.check(self.hello)
        if order.amplifier:
            self.amplifier = ScpiAmplifier(order.amplifier, order.limit_A)
        header = None if order.resume else order.header | self._device_header()
        if order.resume:
            self._check_resume()
        self.log = LogWriter(order.path, header, order.durable)
        ended = Ended("the recorder failed", 6)
        try:
            if order.resume:
                self.segment = order.resume_from
                self.log.event("resume", **self._device_header())
            if self.amplifier:
                self.log.event("amplifier", identity=self.amplifier.set_up())
            self._begin_run()
            self._record()
            ended = Ended("done", 0)
        except Ended as reached:
            ended = reached
        except DiskFull as error:
            ended = Ended(str(error), 6)
        except DeviceError as error:
            ended = Ended(str(error), 5 if self.totals["received"] == 0 and not self.pending else 6)
        except LINK_ERRORS as error:
            ended = Ended(f"{order.port}: the link broke ({error})", 6 if self.totals["received"] or self.pending else 5)
        finally:
            summary = self._close(ended)
        return summary

    def _check_resume(self):
        """Refuse another device, or another calibration: a log has one for all its samples."""
        order, now = self.order, self._device_header()
        if order.resume_header.get("device") != now["device"]:
            raise ConfigurationError(
                f"{order.path}: recorded from {order.resume_header.get('device')}, but {now['device']} answers; give a new --out"
            )
        if order.resume_header.get("channels") != now["channels"]:
            raise ConfigurationError(
                f"{order.path}: the device's channels or calibration are no longer those of this log; give a new --out"
            )

    def _connect(self):
        self.port = open_port(self.order.port, self.order.baud)
        if self.order.text is None:
            self.hello = ask_hello(self.port, self.order.boot_wait_s, self.adapter.splitter)
        else:
            end = time.monotonic() + self.order.boot_wait_s
            held = []
            while self.adapter.hello is None and time.monotonic() < end:
                try:
                    held += self.adapter.feed(quick_read(self.port))
                except LINK_ERRORS as error:
                    raise DeviceError(f"{self.order.port}: the link broke before the first line ({error})") from None
            if self.adapter.hello is None:
                raise DeviceError(
                    f"{self.order.port}: no line # seq,t_us,... within {self.order.boot_wait_s:g} s; name the columns with --text COLUMNS"
                )
            self.hello = self.adapter.hello
        self.adapter.channels = len(self.hello.channels)

    def _device_header(self):
        h = self.hello
        channels = [{"name": c.name, "unit": c.unit, "scale": c.scale, "offset": c.offset} for c in h.channels]
        return {"device": h.device, "firmware": h.firmware, "boot_id": h.boot_id, "port": self.order.port, "channels": channels}

    def _begin_run(self):
        """Upload the drive and start a new segment."""
        self.attempts += 1
        if self.attempts > self.order.attempts:
            raise Ended(f"given up after {self.order.attempts} starts; see the events in the log", 6)
        order = self.order
        self.segment += 1
        self.final, self.quiet_since, self.asked, self.saved = None, time.monotonic(), 0.0, 0
        if order.text is not None:
            self.tracker = None
            self.log.event("start", segment=self.segment, **order.about)
            return
        if self.hello.running:
            end_foreign_run(self, order.stop_wait_s)
        if order.demagnetize and order.drive:
            demagnetize(self, order, self.hello)
            self.log.event("demagnetized", segment=self.segment)
        for packet in order.drive_packets():
            command(self, packet, packet[0], order.stop_wait_s + 2.0)
        run = (order.run + self.segment) & 0xFFFFFFFF
        answer, backlog = command(self, p.start_packet(run, order.rate, order.total_samples), p.START, order.start_wait_s)
        rate = float(json.loads(answer.text or "{}").get("rate_Hz", order.rate))
        self.tracker = Tracker(rate, answer.value, self.hello.frame_samples, self.hello.clock_bits)
        self.patience = 2 * self.hello.frame_samples / rate  # a slow device sends a frame now and then
        self.run_number = run
        self.log.event(
            "start", segment=self.segment, rate_Hz=rate, run=run, boot_id=self.hello.boot_id, **order.about, **order.command()
        )
        self.quiet_since = time.monotonic()
        for kind, value in backlog:
            self._take(kind, value)

    def check_stop(self):
        """Raise `Ended` where a signal asked for the end."""
        if self.stop:
            raise Ended(*self.stop)

    def _record(self):
        begin = time.monotonic()
        self.alive = self.flushed = self.told = begin
        while True:
            try:
                messages = self.adapter.feed(self.port.read(READ))
                for kind, value in messages:
                    self._take(kind, value)
                if self.final is None:
                    self._timers(begin)
            except LINK_ERRORS as error:
                self._reconnect(error)
            if self.final is not None and self._run_over():
                return

    def _timers(self, begin):
        now, order = time.monotonic(), self.order
        self.check_stop()
        if order.max_s and now - begin > order.max_s:
            raise Ended(f"the duration limit of {order.max_s:g} s is reached", 0 if not order.total_samples else 6)
        if self.hello.watchdog_s and now - self.alive > 0.25 * self.hello.watchdog_s:
            self.port.write(encode(p.bare_packet(p.ALIVE)))
            self.alive = now
        if now - self.flushed > FLUSH:
            self._flush()
            self.flushed = now
        if now - self.told > TELL:
            self._progress()
            self.told = now
        silent = now - self.quiet_since
        if silent > order.stall_s + self.patience and now - self.asked > 1.0:
            if self.asked < self.quiet_since:
                self.log.event("stall", segment=self.segment, silent_s=silent)
            self.asked = now
            if order.text is None:
                self.port.write(encode(p.bare_packet(p.QUERY)))
        if silent > order.give_up_s + self.patience:
            raise Ended(f"{order.port}: the device has been silent for {silent:.1f} s", 6)

    def _run_over(self) -> bool:
        """FINAL came: True where the recording is complete, a new start where the device ended the run by itself."""
        if self.final.reason in (0, 1):
            return True
        self.log.event("ended by the device", segment=self.segment, reason=p.REASONS.get(self.final.reason, str(self.final.reason)))
        if self.final.reason == 3:
            raise Ended("the device stopped at its own limit", 6)
        self._settle_accounts()
        self._begin_run()
        return False

    # messages

    def _take(self, kind, value):
        if kind == p.DATA:
            self._take_data(value)
        elif kind == p.FINAL:
            final = p.read_final(value)
            if self.order.text is None and self.tracker and final.run == self.run_number:
                self.final = final
        elif kind == p.HELLO:
            self._take_hello(p.read_hello(value))
        elif kind == p.NOTE:
            self.log.event("note", text=value[2:].decode("utf-8", "replace"))

    def _take_data(self, frame):
        if self.tracker is None:
            self.tracker = Tracker(self.order.rate, frame.seq, 0)
        count = len(frame.counts)
        place = self.tracker.accept(frame.seq, frame.time_us, count)
        if place is None:
            return
        if place == "reset":
            self._lost_device("the sequence numbers began anew")
            return
        self.quiet_since = time.monotonic()
        index, time_us = place
        if self.pending and index != self.pending_at[0] + self.pending_count:
            self._flush()
        if self.tracker.gaps and self.tracker.gaps[-1][0] + self.tracker.gaps[-1][1] == index:
            self.log.event("gap", segment=self.segment, first=self.tracker.gaps[-1][0], samples=self.tracker.gaps[-1][1])
        if not self.pending:
            self.pending_at, self.pending_count = (index, time_us), 0
        self.pending.append(frame.counts)
        self.pending_count += count
        self.pending_last = time_us

    def _take_hello(self, hello):
        if hello.device != self.hello.device:
            raise Ended(f"another device answers: {hello.device} where {self.hello.device} was recorded", 6)
        known, self.hello = self.hello, hello
        if self.order.text is not None:
            return
        if self.tracker is None:
            self._lost_device("its answer to START was lost")
            return
        if hello.boot_id != known.boot_id:
            self._lost_device(f"the device was reset (boot_id {hello.boot_id})")
            return
        last = hello.last or {}
        if not hello.running and last.get("run") == self.run_number:
            self.final = p.Final(*(int(last[k]) for k in ("reason", "run", "last_seq", "frames", "samples", "dropped")))
        elif not hello.running:
            self._lost_device("the device does not know the run")

    def _lost_device(self, why):
        """A reset within a run: book what is known, start again in a new segment."""
        self._flush()
        self.log.event("reset", segment=self.segment, why=why)
        self._settle_accounts()
        self._begin_run()

    def _flush(self):
        """Pending samples into the log; they count as acknowledged once they are safe."""
        if self.pending:
            counts = np.concatenate(self.pending)
            self.pending = []
            self.log.data(self.segment, self.pending_at[0], (self.pending_at[1], self.pending_last), counts)
            self.saved += len(counts)
            self.totals["received"] += len(counts)
            self.waiting.append((self.log.written, self.totals["received"]))
            self._guard(counts)
        while self.waiting and self.waiting[0][0] <= self.log.safe:
            self.acknowledged = self.waiting.pop(0)[1]

    def _guard(self, counts):
        """The current limit, and the points of the live loop."""
        columns = {c.name: k for k, c in enumerate(self.hello.channels)}
        keep = counts[-self.order.loop_samples :]
        self.loop = keep[:: max(len(keep) // 60, 1)]
        if "current" in columns and self.order.limit_A:
            k = columns["current"]
            extreme = max(abs(self.hello.channels[k].to_si([counts[:, k].min(), counts[:, k].max()])))
            if extreme > 1.1 * self.order.limit_A:
                raise Ended(f"the measured current reached {extreme:.4g} A where the limit is {self.order.limit_A:g} A", 6)

    # trouble and ends

    def _reconnect(self, error):
        """The port broke: look for the same device, under other names too."""
        self._flush()
        self.log.event("disconnect", segment=self.segment, why=str(error))
        shut(self.port)
        end = time.monotonic() + self.order.give_up_s
        while time.monotonic() < end:
            for name in candidates(self.order.port):
                port = try_device(
                    name, self.order.baud, None if self.order.text is not None else self.hello, self.order.boot_wait_s / 5
                )
                if port is None:
                    continue
                self.port, hello = port[0], port[1] or self.hello
                self.adapter.forget()
                self.quiet_since = time.monotonic()
                self.log.event("reconnect", segment=self.segment, port=name, boot_id=hello.boot_id)
                self._take_hello(hello)
                return
            self.check_stop()
            time.sleep(0.1)
        raise Ended(f"{self.order.port}: unplugged ({error}) and not back within {self.order.give_up_s:g} s", 6)

    def _settle_accounts(self):
        """Book a segment: received + lost = sent, by the device's own count where it gave one; received is what is in the log."""
        t, tracker = self.totals, self.tracker
        if tracker is None:
            return
        self._flush()
        received, sent = self.saved, tracker.received + tracker.known_lost
        if self.final is not None:
            sent = self.final.samples
            t["dropped_by_device"] += self.final.dropped
        else:
            t["tail_known"] = False
        lost = sent - received
        t["lost"] += lost
        t["sent"] += sent
        t["repeats"] += tracker.repeats
        row = {"segment": self.segment, "received": received, "lost": lost, "sent": sent, "gaps": len(tracker.gaps)}
        self.tracker = None
        told = {"rate_Hz": tracker.rate} if tracker.rate else {}  # again, should the start event be damaged
        self.log.event("counts", **row, tail_known=self.final is not None, **told, **self.order.about)

    def _stop_device(self):
        """STOP until FINAL comes; the drive is at zero then."""
        if self.final is not None or self.order.text is not None:
            return
        end, again = time.monotonic() + self.order.stop_wait_s, 0.0
        try:
            while self.final is None and time.monotonic() < end:
                if time.monotonic() > again:
                    self.port.write(encode(p.bare_packet(p.STOP)))
                    again = time.monotonic() + 0.4
                for kind, value in self.adapter.feed(self.port.read(READ)):
                    if kind == p.DATA and self.tracker:
                        with contextlib.suppress(DiskFull, Ended):  # the drive first: what found no room is booked as lost
                            self._take_data(value)
                    elif kind == p.FINAL:
                        final = p.read_final(value)
                        if self.tracker is None or final.run == self.run_number:
                            self.final = final
        except LINK_ERRORS:
            return  # unplugged: the device's watchdog brings the drive to zero

    def _close(self, ended) -> dict:
        """Drive to zero first, then the books and the last word."""
        status, reason = ended.status, ended.reason
        if self.amplifier:
            try:
                self.amplifier.off()
            except LINK_ERRORS:
                reason += "; the amplifier could not be told to switch off"
        for step in (self._stop_device, self._flush, self._settle_accounts):
            try:
                step()
            except (DiskFull, Ended) as error:
                status, reason = max(status, 6), reason if status else str(error)
        summary = {
            "reason": reason, "status": status, "segments": self.segment + 1, **self.totals, "damaged_frames": self.adapter.damaged,
            "drive_at_zero": self._drive(), "path": str(self.order.path),
        }  # fmt: skip
        if summary["lost"] and not status:
            summary["reason"] = f"{reason}, {summary['lost']} samples lost"
        try:
            self.log.end(summary)
        except DiskFull:
            summary["reason"] = f"{reason} (no room for the log's last chunk)" if "disk" not in reason else reason
        self.log.close()
        shut(self.port)
        self.acknowledged = self.totals["received"]
        return {**summary, "acknowledged": self.acknowledged, "bytes": self.log.written}

    def _drive(self) -> str:
        """How the drive came to zero, in words."""
        if self.order.text is not None:
            return "not driven by magjax"
        if self.final is not None:
            return "confirmed"
        if self.hello.watchdog_s:
            return f"by the device's watchdog ({self.hello.watchdog_s:g} s)"
        return "NOT CONFIRMED, and the device has no watchdog: switch the amplifier off"

    def _progress(self):
        known = self.tracker.known_lost if self.tracker else 0
        loop = None
        if self.loop is not None:
            loop = [[float(v) for v in c.to_si(self.loop[:, k])] for k, c in enumerate(self.hello.channels[:2])]
        self.tell({
            "state": "recording", "acknowledged": self.acknowledged, "received": self.totals["received"], "lost": self.totals["lost"] + known,
            "damaged_frames": self.adapter.damaged, "bytes": self.log.written, "link_bytes": self.adapter.received, "segment": self.segment,
            "disk_free": free_room(self.order.path), "loop": loop, "host_time": time.time(),
        })  # fmt: skip
