"""ArduPilot's bindings, as far as the watchdog script uses them, for a Lua 5.3 of our own.

As strict as the firmware's: wrong arguments are errors, a script that fails or works too long is
removed, outputs count from 0, `uint32_t` wraps, messages come as `mavlink_message_t`. What is not
the same: the firmware's Lua has integers and floats of 32 bits.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lupa import lua53

SCRIPT = Path(__file__).parents[1] / "deploy" / "ardupilot" / "vrspray_watchdog.lua"
QUEUE_MAX = 25
ARMING_TEXT_MAX = 41
# Both names of the vehicle's own system were used by some version; a vehicle has one of them.
PARAMETERS: dict[str, float] = {
    "MAV_SYSID": 1.0,
    **{f"SERVO{channel}_FUNCTION": 0.0 for channel in range(1, 33)},
    **{f"SERVO{channel}_FUNCTION": 32.0 + channel for channel in range(1, 5)},
}

_PRELUDE = """
local host, steps = ...
local U = {}
U.__index = U
local function number(x)
   if getmetatable(x) == U then return x.v end
   assert(math.type(x) == "integer" or x == math.floor(x), "no uint32_t")
   return math.floor(x)
end
local function uint32(v) return setmetatable({v = v & 0xFFFFFFFF}, U) end
U.__sub = function(a, b) return uint32(number(a) - number(b)) end
U.__add = function(a, b) return uint32(number(a) + number(b)) end
U.__lt = function(a, b) return number(a) < number(b) end
U.__le = function(a, b) return number(a) <= number(b) end
U.__eq = function(a, b) return a.v == b.v end
function U:toint() return self.v < 0x80000000 and self.v or self.v - 0x100000000 end
function U:tofloat() return (string.unpack("<f", string.pack("<f", self.v))) end

local function bound(low, high)
   return function(x)
      assert(math.type(x) == "integer" or (type(x) == "number" and x == math.floor(x)), "integer")
      assert(low <= x and x <= high, "out of range")
      return math.floor(x)
   end
end
local byte, word = bound(0, 255), bound(0, 65535)

local env = {}
for _, name in ipairs {"assert", "error", "ipairs", "next", "pairs", "pcall", "select",
                       "setmetatable", "tonumber", "tostring", "type"} do
   env[name] = _G[name]
end
env.math, env.table, env.string, env.utf8 = math, table, string, utf8
env.millis = function() return uint32(host.millis()) end
env.uint32_t = uint32
env.gcs = {send_text = function(_, severity, text)
   assert(type(text) == "string")
   host.say(byte(severity), text)
end}
env.mavlink = {
   init = function(_, queue, ids) host.init(bound(0, 25)(queue), bound(0, 25)(ids)) end,
   register_rx_msgid = function(_, id) return host.register(bound(0, 0xFFFFFF)(id)) end,
   receive_chan = function(_)
      local message, at = host.receive()
      if message == nil then return end
      return message, 0, uint32(at)
   end,
}
env.SRV_Channels = {
   get_output_pwm_chan = function(_, channel)
      return host.read(byte(channel))
   end,
   set_output_pwm_chan = function(_, channel, pulse)
      host.write(byte(channel), word(pulse))
   end,
}
env.param = {
   add_table = function(_, key, prefix, count)
      return host.add_table(bound(0, 200)(key), prefix, bound(0, 63)(count))
   end,
   add_param = function(_, key, index, name, default)
      assert(type(default) == "number")
      return host.add_param(byte(key), byte(index), name, default)
   end,
}
env.Parameter = function(name)
   assert(#name <= 16 and host.has(name), "Invalid parameter name")
   return {get = function(_) return host.get(name) end}
end
env.arming = {
   is_armed = function(_) return host.is_armed() end,
   get_aux_auth_id = function(_) return host.auth_id() end,
   set_aux_auth_failed = function(_, id, text) host.judge(byte(id), text) end,
   set_aux_auth_passed = function(_, id) host.judge(byte(id), nil) end,
}

local runner = {}
function runner.load(source) return assert(load(source, "@watchdog", "t", env)) end
-- Like the firmware: who is over time fails at every further instruction, pcall or not.
function runner.run(f)
   local is_over = false
   local function over()
      is_over = true
      if debug.getinfo(2, "f").func == runner.run then
         debug.sethook()
         return
      end
      debug.sethook(over, "", 1)
      error("Exceeded CPU time")
   end
   debug.sethook(over, "", steps)
   local results = table.pack(pcall(f))
   debug.sethook()
   if is_over then return nil, "exceeded time limit" end
   if not results[1] then return nil, tostring(results[2]) end
   if results.n ~= 3 or type(results[2]) ~= "function" or type(results[3]) ~= "number" then
      return nil, "returned bad result"
   end
   return results[2], results[3]
end
return runner
"""


def message_of(frame: bytes) -> bytes:
    """Return what a script gets of a frame: a `mavlink_message_t`, its payload filled with 0."""
    version, length = frame[0], frame[1]
    if version == 0xFD:
        header, payload = frame[:10], frame[10 : 10 + length]
    elif version == 0xFE:
        header = bytes([0xFE, length, 0, 0, *frame[2:6], 0, 0])
        payload = frame[6 : 6 + length]
    else:
        raise ValueError("no MAVLink frame")
    return b"\0\0" + header + payload.ljust(264, b"\0") + bytes(15)


class FakeAutopilot:
    """Outputs, parameters, messages and the time of an ArduPilot, and one script that runs on it.

    `set_output` hears every pulse that the script writes, with outputs counted from 1. A binding
    whose name is in `broken` fails.
    """

    def __init__(
        self,
        *,
        set_output: Callable[[int, int], None] = lambda channel, pulse_us: None,
        parameters: dict[str, float | None] | None = None,
        script: Path = SCRIPT,
        boot_ms: int = 5_000,
        steps: int = 10_000,
    ) -> None:
        self.set_output = set_output
        self.parameters: dict[str, float] = dict(PARAMETERS)
        for name, value in (parameters or {}).items():
            if value is None:
                self.parameters.pop(name, None)
            else:
                self.parameters[name] = value
        self.now_ms = float(boot_ms)
        self.outputs_us: dict[int, int] = {}
        self.texts: list[str] = []
        self.armed = False
        self.arming_text: str | None = None
        self.broken: set[str] = set()
        self.keys: dict[int, str] = {}
        self.accepted: list[int] = []
        self.accepted_max = -1
        self.error: str | None = None
        self._queue: deque[tuple[str, int]] = deque(maxlen=QUEUE_MAX)
        self._lua = lua53.LuaRuntime(encoding="latin-1", unpack_returned_tuples=True)
        self._runner = self._lua.execute(_PRELUDE, self, steps)
        self._source = script.read_text(encoding="utf-8")
        self._start()

    def _start(self) -> None:
        self._step: Any = self._runner.load(self._source)
        self._next_ms = self.now_ms

    # ------------------------------------------------------------------ for who tests it

    def restart_scripts(self) -> None:
        """Run the script anew; tables, parameters and the queue stay, as on the firmware."""
        self._start()

    def on_message(self, raw: bytes, now_s: float | None = None) -> None:
        """Take a frame from the wire."""
        if now_s is not None:
            self.update(now_s)
        message = message_of(raw)
        if int.from_bytes(message[9:12], "little") in self.accepted and (
            len(self._queue) < QUEUE_MAX  # a full queue takes nothing
        ):
            self._queue.append((message.decode("latin-1"), int(self.now_ms)))

    def order(self, channel: int, pulse_us: int) -> None:
        """Write an output as MAV_CMD_DO_SET_SERVO does."""
        self.outputs_us[channel] = pulse_us

    def update(self, now_s: float) -> None:
        """Let time pass up to `now_s` since the zero of the clock."""
        self.run_until(now_s * 1000.0)

    def run(self, ms: float) -> None:
        """Let time pass."""
        self.run_until(self.now_ms + ms)

    def run_until(self, at_ms: float) -> None:
        """Let time pass, and the script run whenever it is due."""
        while self._step is not None and self._next_ms <= at_ms:
            self.now_ms = max(self.now_ms, self._next_ms)
            self._step, more = self._runner.run(self._step)
            if self._step is None:
                self.error = str(more)
            else:
                self._next_ms = self.now_ms + more
        self.now_ms = max(self.now_ms, at_ms)

    def stall(self, ms: float) -> None:
        """Let time pass while no script runs."""
        self.now_ms += ms
        self._next_ms = max(self._next_ms, self.now_ms)

    # -------------------------------------------------------------------- the bindings

    def _check(self, name: str) -> None:
        if name in self.broken:
            raise RuntimeError(f"{name} is broken")

    def millis(self) -> int:
        self._check("millis")
        return int(self.now_ms)

    def say(self, severity: int, text: str) -> None:
        self._check("send_text")
        self.texts.append(text[:50])

    def init(self, queue: int, ids: int) -> None:
        self._check("init")
        if self.accepted_max < 0:  # what was set up first stands
            self._queue = deque(self._queue, maxlen=queue)
            self.accepted_max = ids

    def register(self, message_id: int) -> bool:
        if message_id in self.accepted:
            return False
        if len(self.accepted) >= self.accepted_max:
            raise RuntimeError("no registrations free")
        self.accepted.append(message_id)
        return True

    def receive(self) -> tuple[str, int] | None:
        self._check("receive_chan")
        return self._queue.popleft() if self._queue else None

    def read(self, channel: int) -> int | None:
        self._check("get_output_pwm_chan")
        return self.outputs_us.get(channel + 1, 0) if channel < 32 else None

    def write(self, channel: int, pulse_us: int) -> None:
        self._check("set_output_pwm_chan")
        if channel < 32:
            self.outputs_us[channel + 1] = pulse_us
            self.set_output(channel + 1, pulse_us)

    def add_table(self, key: int, prefix: str, count: int) -> bool:
        return self.keys.setdefault(key, prefix) == prefix

    def add_param(self, key: int, index: int, name: str, default: float) -> bool:
        self.parameters.setdefault(self.keys[key] + name, float(default))
        return True

    def has(self, name: str) -> bool:
        return name in self.parameters

    def get(self, name: str) -> float | None:
        self._check("get")
        return self.parameters.get(name)

    def is_armed(self) -> bool:
        self._check("is_armed")
        return self.armed

    def auth_id(self) -> int | None:
        self._check("get_aux_auth_id")
        return 3

    def judge(self, auth_id: int, text: str | None) -> None:
        assert text is None or len(text) <= ARMING_TEXT_MAX
        self.arming_text = text
