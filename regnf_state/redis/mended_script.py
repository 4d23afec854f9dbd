"""Lua that our scripts share: a command that goes on past what has been damaged in its key."""

# A key of another type is set aside for a week, and begun anew; so is a count that nothing can be added to. One script
# runs whole or not at all only as long as none of its commands fails: those before it are not undone.
MENDED = """
local function mended(command)
  local done = redis.pcall(unpack(command))
  local said = type(done) == 'table' and done.err
  if not said then return done end
  if string.find(said, 'WRONGTYPE') then
    redis.call('RENAME', command[2], 'regnf:quarantine:' .. command[2])
    redis.call('EXPIRE', 'regnf:quarantine:' .. command[2], 604800)
  elseif string.find(said, 'hash value') or string.find(said, 'overflow') or string.find(said, 'Infinity') then
    redis.call('HDEL', command[2], command[3])
  else
    return done
  end
  return redis.call(unpack(command))
end
"""
