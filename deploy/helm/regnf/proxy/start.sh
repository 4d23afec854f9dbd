#!/bin/sh
# Starts nginx on port 8000: with TLS where the folder of the certificate holds tls.crt and tls.key, in clear text otherwise.
set -eu
if [ -f /etc/regnf-tls/tls.crt ]; then
    cat > /tmp/listen.conf <<END
listen 8000 ssl;
ssl_certificate /etc/regnf-tls/tls.crt;
ssl_certificate_key /etc/regnf-tls/tls.key;
ssl_protocols TLSv1.2 TLSv1.3;
END
else
    echo "listen 8000;" > /tmp/listen.conf
fi
exec nginx -c /etc/regnf/nginx.conf
