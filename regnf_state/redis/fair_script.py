"""The script of the fair queue, in Lua: one step of it is one call, and Redis runs each call whole or not at all.

A caller's waiting work is a line, first come first served; but jobs of batches stand behind all that was posted by
itself, and its imports. The callers with a line are sorted by their tags: a tag is
the time, in worker seconds by weight, up to which the caller has been served. The first of the line with the least tag
lies in RQ's list, where the workers block; nothing else of ours does. Every call begins with ``settle``: what lay in
RQ's list and does not any more was taken by a worker, and its caller's tag rises by the estimate; what still lies there
goes back to the front of its line. Every call ends with ``advance``, which chooses anew. So no call relies on the one
before it: after the death of any process the next call of any other puts the state in order.

One worker stays free for callers who come back: ``held_back``. Which workers a caller holds is told by what they report
themselves, and Redis lets expire; no count is kept that a death could leave wrong.

Keys, below the prefix:  line:{owner}   list of names        owners        sorted set: callers with a line, by tag
                         entry:{name}   hash, see below      tags, weights, costs   hashes, by owner
                         parked:{ref}   list of names        parkings      set: fields that something waits for
                         spent:{owner}  hash: worker seconds by minute     clock   hash: now; ready, owner
                         taken          set: names that workers have       asked   sorted set: callers, by last request
An entry: owner, kind, since, batch (of one); once taken: cost, taken; while it waits for a field: parked.
"""

from regnf_state.redis.unreadable import MENDED

SCRIPT = (
    MENDED
    + """
local P, op, name = KEYS[1], ARGV[1], ARGV[2]
local FIRST, CREDIT, RESERVE, DAY = tonumber(ARGV[3]), tonumber(ARGV[5]), tonumber(ARGV[6]), 86400
local BEGIN = 15  -- a worker that has taken work reports it within so many seconds
local LISTS = {import = 'rq:queue:regnf-import', registration = 'rq:queue:regnf'}
local WORKERS = 'rq:workers:regnf'
local time = redis.call('TIME')
local now = time[1] + time[2] / 1e6

local function entry_of(id) return P .. 'entry:' .. id end
local function line_of(owner) return P .. 'line:' .. owner end
-- what is no number, or none that seconds can be, counts as if it were not there
local function number(held, otherwise)
  local found = tonumber(held or '')
  return found and math.abs(found) < 1e12 and found or otherwise
end

local function tag_of(owner) return number(redis.call('HGET', P .. 'tags', owner), 0) end
local function clock() return number(redis.call('HGET', P .. 'clock', 'now'), 0) end
local function weight_of(owner)
  local weight = number(redis.call('HGET', P .. 'weights', owner), 1)
  return weight >= 1e-6 and weight or 1
end

local function text(number) return string.format('%.6f', number) end

local function cost_of(owner, kind)
  return number(redis.call('HGET', P .. 'costs', owner .. '|' .. kind), FIRST)
end

local function set_tag(owner, tag)
  redis.call('HSET', P .. 'tags', owner, text(tag))
  if redis.call('EXISTS', line_of(owner)) == 1 then
    redis.call('ZADD', P .. 'owners', text(tag), owner)
  else
    redis.call('ZREM', P .. 'owners', owner)
  end
end

local function charge(owner, seconds)
  set_tag(owner, tag_of(owner) + seconds / weight_of(owner))
  local key, minute = P .. 'spent:' .. owner, math.floor(now / 60)
  redis.call('HINCRBYFLOAT', key, string.format('%d', minute), text(seconds))
  for _, each in ipairs(redis.call('HKEYS', key)) do
    if number(each, 0) <= minute - 60 then redis.call('HDEL', key, each) end
  end
  redis.call('EXPIRE', key, 7200)
end

local function note_asked(owner)
  redis.call('ZADD', P .. 'asked', text(now), owner)
  redis.call('ZREMRANGEBYSCORE', P .. 'asked', '-inf', text(now - DAY))
end

-- a caller who had no line gains the credit at most for the time without: its first work goes before that of those
-- who have been served all the while, and not more than that
local function join(owner, id, push, before)
  local idle = redis.call('EXISTS', line_of(owner)) == 0
  if before then
    redis.call('LINSERT', line_of(owner), 'BEFORE', before, id)
  else
    redis.call(push, line_of(owner), id)
  end
  set_tag(owner, idle and math.max(clock() - CREDIT, tag_of(owner)) or tag_of(owner))
end

-- the first job of a batch in the line: all before it was posted by itself, and is seldom much
local function first_of_batch(owner)
  for start = 0, redis.call('LLEN', line_of(owner)) - 1, 64 do
    for _, id in ipairs(redis.call('LRANGE', line_of(owner), start, start + 63)) do
      if redis.call('HEXISTS', entry_of(id), 'batch') == 1 then return id end
    end
  end
end

local function settle()
  local ready = redis.call('HMGET', P .. 'clock', 'ready', 'owner')
  local id, owner = ready[1], ready[2]
  if not id then return end
  redis.call('HDEL', P .. 'clock', 'ready', 'owner')
  if not owner then return end
  local kind = redis.call('HGET', entry_of(id), 'kind')
  if not LISTS[kind] then return end
  if redis.call('LREM', LISTS[kind], 1, id) == 1 then
    redis.call('LPUSH', line_of(owner), id)
    set_tag(owner, tag_of(owner))
    return
  end
  local cost = cost_of(owner, kind)
  redis.call('HSET', P .. 'clock', 'now', text(math.max(clock(), tag_of(owner))))
  redis.call('HSET', entry_of(id), 'cost', text(cost), 'taken', text(now))
  redis.call('EXPIRE', entry_of(id), DAY)
  redis.call('SADD', P .. 'taken', id)
  charge(owner, cost)
end

-- that a worker reports is told by what Redis lets expire: times in RQ's own lists are of the workers' clocks
local function runs(id)
  if redis.call('TYPE', 'rq:executions:' .. id).ok ~= 'zset' then return false end
  for _, one in ipairs(redis.call('ZRANGE', 'rq:executions:' .. id, 0, -1)) do
    if redis.call('EXISTS', 'rq:execution:' .. id .. ':' .. one) == 1 then return true end
  end
  return false
end

-- how many workers each caller holds, and how many are held in all
local function held()
  local by_owner, total = {}, 0
  for _, id in ipairs(redis.call('SMEMBERS', P .. 'taken')) do
    local entry = redis.call('HMGET', entry_of(id), 'owner', 'taken')
    local owner, taken = entry[1], number(entry[2], nil)
    if owner and taken and (math.abs(now - taken) < BEGIN or runs(id)) then
      by_owner[owner], total = (by_owner[owner] or 0) + 1, total + 1
    else
      redis.call('SREM', P .. 'taken', id)
    end
  end
  return by_owner, total
end

local function live_workers()
  local live = 0
  if redis.call('TYPE', WORKERS).ok ~= 'set' then return 0 end
  for _, key in ipairs(redis.call('SMEMBERS', WORKERS)) do
    if redis.call('TYPE', key).ok == 'hash' and redis.call('HEXISTS', key, 'death') == 0 then live = live + 1 end
  end
  return live
end

-- whether another caller who holds no worker has asked for something lately, and would have less with one, by weight,
-- than the owner with one more
local function somebody_has_less(owner, by_owner)
  local share = (by_owner[owner] + 1) / weight_of(owner)
  for _, other in ipairs(redis.call('ZRANGEBYSCORE', P .. 'asked', text(now - RESERVE), text(now + RESERVE))) do
    if other ~= owner and not by_owner[other] and 1 / weight_of(other) < share then return true end
  end
  return false
end

-- a caller who holds a worker does not get the last free one while it may be for somebody who has less
local function held_back(owner, by_owner, total)
  if not by_owner[owner] then return false end
  local live = live_workers()
  return live > 1 and live - total <= 1 and somebody_has_less(owner, by_owner)
end

local function next_owner()
  local owners = redis.call('ZRANGE', P .. 'owners', 0, -1)
  if RESERVE <= 0 or #owners == 0 then return owners[1] end
  local by_owner, total = held()
  for _, owner in ipairs(owners) do
    if not held_back(owner, by_owner, total) then return owner end
  end
end

local function advance()
  if redis.call('LLEN', LISTS.import) + redis.call('LLEN', LISTS.registration) > 0 then return end
  while true do
    local owner = next_owner()
    if not owner then return end
    local id = redis.call('LPOP', line_of(owner))
    set_tag(owner, tag_of(owner))
    local kind = id and redis.call('HGET', entry_of(id), 'kind')
    if LISTS[kind] then
      redis.call('HSET', P .. 'clock', 'ready', id, 'owner', owner)
      redis.call('RPUSH', LISTS[kind], id)
      return
    end
  end
end

local function waits(id)
  local entry = redis.call('HMGET', entry_of(id), 'owner', 'parked')
  if entry[1] and redis.call('LPOS', line_of(entry[1]), id) then return true end
  if entry[2] and redis.call('LPOS', P .. 'parked:' .. entry[2], id) then return true end
  return redis.call('LPOS', LISTS.import, id) or redis.call('LPOS', LISTS.registration, id)
end

local function remove(id)
  local entry = redis.call('HMGET', entry_of(id), 'owner', 'parked')
  local found = redis.call('LREM', LISTS.import, 0, id) + redis.call('LREM', LISTS.registration, 0, id)
  if entry[1] then
    found = found + redis.call('LREM', line_of(entry[1]), 0, id)
    set_tag(entry[1], tag_of(entry[1]))
  end
  if entry[2] then found = found + redis.call('LREM', P .. 'parked:' .. entry[2], 0, id) end
  redis.call('DEL', entry_of(id))
  return found
end

local steps = {}

-- what has been waiting already stays where it is; a leftover of a worker's death is replaced
function steps.enqueue(owner, kind, weight, batch, ...)
  if waits(name) or runs(name) then return 0 end
  remove(name)
  redis.call('DEL', 'rq:job:' .. name)
  redis.call('HSET', 'rq:job:' .. name, ...)
  redis.call('HSET', entry_of(name), 'owner', owner, 'kind', kind, 'since', text(now))
  redis.call('HSET', P .. 'weights', owner, weight)
  note_asked(owner)
  if batch == '1' then redis.call('HSET', entry_of(name), 'batch', 1) end
  join(owner, name, 'RPUSH', batch ~= '1' and first_of_batch(owner))
  return 1
end

function steps.turn() return 0 end

function steps.holds() return (waits(name) or runs(name)) and 1 or 0 end

function steps.remove()
  if remove(name) == 0 then return 0 end
  redis.call('DEL', 'rq:job:' .. name)
  return 1
end

-- the run has ended after so many seconds: the estimate is put right
function steps.finish(seconds)
  local entry = redis.call('HMGET', entry_of(name), 'owner', 'kind', 'cost')
  redis.call('DEL', entry_of(name))
  local owner, kind, cost = entry[1], entry[2], number(entry[3], nil)
  if not owner or not kind or not cost then return 0 end
  redis.call('HSET', P .. 'costs', owner .. '|' .. kind, seconds)
  mended({'HINCRBYFLOAT', ARGV[4], 'worker_seconds|' .. owner .. '|' .. kind, seconds})
  charge(owner, tonumber(seconds) - cost)
  note_asked(owner)
  return 1
end

-- taken, but it cannot run before the import of this field has ended: it pays nothing meanwhile
function steps.park(owner, kind, reference)
  local cost = number(redis.call('HGET', entry_of(name), 'cost'), nil)
  if cost then charge(owner, -cost) end
  redis.call('HDEL', entry_of(name), 'cost', 'taken')
  redis.call('HSETNX', entry_of(name), 'since', text(now))
  redis.call('HSET', entry_of(name), 'owner', owner, 'kind', kind, 'parked', reference)
  redis.call('PERSIST', entry_of(name))
  redis.call('RPUSH', P .. 'parked:' .. reference, name)
  redis.call('SADD', P .. 'parkings', reference)
  return 1
end

-- ``name`` is the field; those who have waited longest come first
function steps.release()
  local parked = redis.call('LRANGE', P .. 'parked:' .. name, 0, -1)
  for index = #parked, 1, -1 do
    local owner = redis.call('HGET', entry_of(parked[index]), 'owner')
    if owner then
      redis.call('HDEL', entry_of(parked[index]), 'parked')
      join(owner, parked[index], 'LPUSH')
    end
  end
  redis.call('DEL', P .. 'parked:' .. name)
  redis.call('SREM', P .. 'parkings', name)
  return #parked
end

settle()
local answer = steps[op](unpack(ARGV, 7))
advance()
return answer
"""
)
