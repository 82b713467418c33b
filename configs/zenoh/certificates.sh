#!/bin/sh
# SPDX-License-Identifier: BSD-3-Clause
# Creates a certificate authority and the certificates for server.json5 and member.json5:
#   sh certificates.sh FOLDER HOST [NAME...]
# HOST is the server's name or IPv4 address, as clients use it. Each NAME is a role: camera, viewer or operator (by
# default all three). A second run with the same FOLDER uses the same authority and adds missing certificates.
# Copy FOLDER/server/tls to the server, FOLDER/camera/tls to the cameras' machines, and so on. Do not distribute
# FOLDER/authority.key: it can sign certificates for any role.
set -eu
[ $# -ge 2 ] || { echo "use: sh certificates.sh FOLDER HOST [camera|viewer|operator...]" >&2; exit 2; }
folder=$1 host=$2
shift 2
[ $# -gt 0 ] || set -- camera viewer operator
umask 077
mkdir -p "$folder"
cd "$folder"

[ -f authority.key ] || openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 3650 \
    -subj "/CN=roundel authority" -keyout authority.key -out authority.pem 2>/dev/null

case $host in
*[!0-9.]*) names="DNS:$host" ;;
*) names="IP:$host" ;;
esac

sign() { # NAME EXTENSIONS: server.json5 grants rights by the name in the certificate
    [ ! -f "$1/tls/member.pem" ] || return 0
    mkdir -p "$1/tls"
    openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj "/CN=$1" \
        -keyout "$1/tls/member.key" -out "$1/request" 2>/dev/null
    printf 'basicConstraints=CA:FALSE\n%s\n' "$2" >"$1/extensions"
    openssl x509 -req -in "$1/request" -CA authority.pem -CAkey authority.key -CAcreateserial -days 3650 \
        -extfile "$1/extensions" -out "$1/tls/member.pem" 2>/dev/null
    rm "$1/request" "$1/extensions"
    cp authority.pem "$1/tls/authority.pem"
}

sign server "extendedKeyUsage=serverAuth,clientAuth
subjectAltName=$names,DNS:localhost,IP:127.0.0.1"
for name; do
    sign "$name" "extendedKeyUsage=clientAuth"
done
