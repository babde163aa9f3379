--[[
   vrspray_watchdog.lua: closes the spray valves when the companion computer falls silent.

   An order of MAV_CMD_DO_SET_SERVO has no end: an autopilot whose companion has lost power goes
   on with the last pulse for ever. While vrspray may have a valve open it sends NAMED_VALUE_FLOAT "SPR_LIVE"
   ten times a second. This script writes the closed pulse to the valves' outputs

     - from its first run until the first sign of life,
     - from SPRW_TIMEOUT_MS after the last one until the next one,

   every 20 ms, whoever else writes to these outputs. It never opens a valve by itself, but for the
   return valve that has to be open while the others are closed (SPRW_RET_CH).

   ArduPilot whose scripts can receive MAVLink, SCR_ENABLE = 1; copy to APM/scripts on the card,
   restart, set SPRW_FIRST and SPRW_LAST. Settings are read while disarmed only. A setting that
   cannot work refuses arming and says why. README.md beside this file has all of it.
--]]

-- The key of the parameter table may be used by one script only on a flight controller.
local TABLE_KEY = 163
local PREFIX = "SPRW_"
local DEFAULTS = {
   {"ENABLE", 1}, -- 0: the script does nothing; taken while disarmed only
   {"COMPID", 191}, -- MAVLink component of the companion: link.component_id
   {"SYSID", 0}, -- its MAVLink system; 0: the vehicle's own, which is what vrspray uses
   {"FIRST", 0}, -- outputs FIRST to LAST are valves or motors, counted from 1; 0: none
   {"LAST", 0},
   {"MASK", 0}, -- and of outputs 1 to 16 those whose bit is set (bit 0 is output 1)
   {"CLOSED_US", 1000}, -- output.closed_us; it must stop a pump or atomiser too
   {"TIMEOUT_MS", 300}, -- held to 200 to 1000
   {"RET_CH", 0}, -- output of a return valve; 0: none
   {"RET_US", 2000}, -- its open pulse
}

local PERIOD_MS = 20
local CONFIGURE_TICKS = 50 -- once a second
local COMPLAIN_TICKS = 500 -- every 10 s

local NAMED_VALUE_FLOAT = 251
local PAYLOAD_LENGTH = 18 -- uint32 time, float value, char[10] name
local SIGN_OF_LIFE = "SPR_LIVE\0"
-- As many messages as the queue of the firmware can hold; it is shared by all scripts.
local QUEUE_LENGTH = 25
local MESSAGE_IDS = 10

local WARNING, INFO = 4, 6 -- MAV_SEVERITY

local settings = {} -- name to Parameter
local channels = {} -- outputs of valves and motors, counted from 1
local wanted = {} -- the same before SERVOn_FUNCTION was looked at
local closed_us = nil -- the last one that could be used; without one there is no pulse
local return_channel, return_us = nil, nil
local timeout_ms = 300
local component, system = nil, nil
local is_watching = true
local has_read = false
local load_problem, problem = nil, nil

local heard_ms = nil -- when the last sign of life was received
local is_alive = false
local has_spoken = false
local auth_id = nil
local tick, said_tick = 0, nil

local function say(severity, text)
   gcs:send_text(severity, "Spray watchdog: " .. text)
end

-- Return value if it is a whole number from low to high, else nil; so also for NaN and nil.
local function whole(value, low, high)
   if value and value >= low and value <= high and value == math.floor(value) then
      return math.floor(value)
   end
   return nil
end

-- Return a parameter's value, or nil where there is no such parameter.
local function value_of(name)
   local found, parameter = pcall(Parameter, name)
   if found and parameter then
      return parameter:get()
   end
   return nil
end

local function setting(name)
   local parameter = settings[name]
   return parameter and parameter:get()
end

-- ------------------------------------------------------------------------------ configuration

-- Functions for which MAV_CMD_DO_SET_SERVO may write. Nothing is ever written to any other output:
-- it could be a motor.
local function is_free(channel)
   local number = whole(value_of(string.format("SERVO%d_FUNCTION", channel)), 0, 255)
   if not number then
      return false
   end
   return number <= 1 or number == 22 or number == 23 or number == 28
      or (number >= 51 and number <= 66) or (number >= 140 and number <= 155)
end

local function read_settings()
   is_watching = not (setting("ENABLE") == 0)
   component = whole(setting("COMPID"), 1, 255)
   system = whole(setting("SYSID"), 1, 255)
   if setting("SYSID") == 0 then
      -- Its name until 4.6, and since.
      system = whole(value_of("MAV_SYSID") or value_of("SYSID_THISMAV"), 1, 255)
   end
   local given_ms = setting("TIMEOUT_MS")
   timeout_ms = 300
   if given_ms and given_ms == given_ms then
      timeout_ms = math.min(math.max(given_ms, 200), 1000)
   end
   local given_us = whole(setting("CLOSED_US"), 500, 2500)
   closed_us = given_us or closed_us
   local first = whole(setting("FIRST"), 1, 32) or 33
   local last = whole(setting("LAST"), 1, 32) or 0
   local mask = whole(setting("MASK"), 0, 65535) or 0
   wanted = {}
   for channel = 1, 32 do
      local in_mask = channel <= 16 and (mask & (1 << (channel - 1))) ~= 0
      if in_mask or (channel >= first and channel <= last) then
         wanted[#wanted + 1] = channel
      end
   end
   return_channel = whole(setting("RET_CH"), 1, 32)
   return_us = whole(setting("RET_US"), 500, 2500)

   -- At most 34 characters: a text holds 50, a reason not to arm 41.
   if load_problem then
      return load_problem
   elseif not component then
      return "SPRW_COMPID must be 1 to 255"
   elseif not system then
      return "SPRW_SYSID: no MAVLink system"
   elseif not given_us then
      return "SPRW_CLOSED_US must be 500 to 2500"
   elseif #wanted == 0 then
      return "set SPRW_FIRST and SPRW_LAST"
   elseif setting("RET_CH") ~= 0 and not (return_channel and return_us) then
      return "SPRW_RET_CH or SPRW_RET_US wrong"
   end
   return nil
end

local function configure()
   -- In flight settings stand still; a script that is restarted in flight has to read them once.
   if not has_read or not arming:is_armed() then
      problem = read_settings()
      has_read = true
   end
   local free = {}
   for _, channel in ipairs(wanted) do
      if is_free(channel) then
         free[#free + 1] = channel
      else
         problem = problem or string.format("SERVO%d_FUNCTION must be 0", channel)
      end
   end
   channels = free
   if return_channel and not is_free(return_channel) then
      problem = problem or string.format("SERVO%d_FUNCTION must be 0", return_channel)
      return_channel = nil
   end
end

-- Refuse arming while a setting cannot work. A build without this check still has the texts.
local function tell_arming()
   auth_id = auth_id or arming:get_aux_auth_id()
   if auth_id and is_watching and problem then
      arming:set_aux_auth_failed(auth_id, problem)
   elseif auth_id then
      arming:set_aux_auth_passed(auth_id)
   end
end

-- ------------------------------------------------------------------------------- sign of life

-- Return whether message, a mavlink_message_t, is a sign of life of our companion: bytes 1 and 2 are
-- its checksum, 4 the length, 8 and 9 the sender, 10 to 12 the message, the payload begins at 13.
local function is_sign_of_life(message)
   local length = message:byte(4)
   local from_system, from_component = message:byte(8, 9)
   local low, middle, high = message:byte(10, 12)
   if low ~= NAMED_VALUE_FLOAT or middle ~= 0 or high ~= 0 then
      return false
   end
   if from_system ~= system or from_component ~= component then
      return false
   end
   -- MAVLink 2 leaves zeros at the end of a payload out.
   local payload = message:sub(13, 12 + math.min(length, PAYLOAD_LENGTH))
   payload = payload .. string.rep("\0", PAYLOAD_LENGTH - #payload)
   local value = string.unpack("<f", payload, 5)
   return value > 0 and payload:sub(9, 8 + #SIGN_OF_LIFE) == SIGN_OF_LIFE
end

-- Take what came in, oldest first; a message counts from when it was received.
local function listen()
   for _ = 1, QUEUE_LENGTH do
      local message, _, received_ms = mavlink:receive_chan()
      if not message then
         return
      end
      if is_sign_of_life(message) then
         heard_ms = received_ms or millis()
      end
   end
end

-- ------------------------------------------------------------------------------------ closing

local function close()
   local pulse_us = closed_us or 0
   local was_open = false
   for _, channel in ipairs(channels) do
      local found_us = SRV_Channels:get_output_pwm_chan(channel - 1)
      was_open = was_open or (found_us and found_us ~= 0 and found_us ~= pulse_us)
      SRV_Channels:set_output_pwm_chan(channel - 1, pulse_us)
   end
   if return_channel and return_us then
      SRV_Channels:set_output_pwm_chan(return_channel - 1, return_us)
   end
   return was_open
end

local function complain(text)
   if not said_tick or tick - said_tick >= COMPLAIN_TICKS then
      said_tick = tick
      say(WARNING, text)
   end
end

local function update()
   if tick % CONFIGURE_TICKS == 1 then
      configure()
      pcall(tell_arming)
   end
   listen()
   if heard_ms and not ((millis() - heard_ms):tofloat() < timeout_ms) then
      heard_ms = nil -- for good: 49.7 days later it would look young again
   end
   is_alive = heard_ms ~= nil
   if not is_watching then
      return
   end
   if problem then
      complain(problem)
   end
   if is_alive then
      if has_spoken then
         has_spoken = false
         say(INFO, "sign of life is back")
      end
   elseif close() and not has_spoken then
      has_spoken = true
      say(WARNING, "no sign of life, closed")
   end
end

-- An error would end the script, and with it the watch: close and go on instead.
local function guarded()
   tick = tick + 1
   local has_worked, reason = pcall(update)
   if not has_worked then
      heard_ms = nil
      if is_watching then
         pcall(close)
      end
      pcall(complain, tostring(reason))
   end
   return guarded, PERIOD_MS
end

-- -------------------------------------------------------------------------------------- start

local function add_settings()
   if not param:add_table(TABLE_KEY, PREFIX, #DEFAULTS) then
      error("table")
   end
   for number, default in ipairs(DEFAULTS) do
      if not param:add_param(TABLE_KEY, number, default[1], default[2]) then
         error("parameter")
      end
      settings[default[1]] = Parameter(PREFIX .. default[1])
   end
end

local function subscribe()
   -- The length of the queue, the number of message ids; what another script has set up stands.
   mavlink:init(QUEUE_LENGTH, MESSAGE_IDS)
   mavlink:register_rx_msgid(NAMED_VALUE_FLOAT) -- false if it is registered already
end

if not pcall(add_settings) then
   load_problem = "parameter table 163 is taken"
elseif not pcall(subscribe) then
   load_problem = "no room for NAMED_VALUE_FLOAT"
end

say(INFO, "started")
return guarded()
