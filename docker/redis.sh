#!/bin/sh
# Starts Redis with a password that the first start draws and keeps beside the data, where front end and workers read it.
# Commands that would change the server, read its files or empty it are for nobody. Arguments go to the server.
set -eu
data=${REDIS_DATA:-/data}
umask 022
if [ ! -s "$data/password" ]; then
    head -c 32 /dev/urandom | od -An -v -tx1 | tr -d ' \n' > "$data/password.new"
    mv "$data/password.new" "$data/password"
fi
users=${REDIS_RUN:-/tmp}/users.acl
refused="-acl -config -debug -module -replicaof -slaveof -psync -sync -migrate -failover -cluster -monitor -shutdown"
refused="$refused -flushall -flushdb -swapdb -save -bgsave -bgrewriteaof"
(umask 077 && printf 'user default on >%s ~* &* +@all %s\n' "$(cat "$data/password")" "$refused" > "$users")
exec "${REDIS_SERVER:-valkey-server}" --dir "$data" --aclfile "$users" "$@"
