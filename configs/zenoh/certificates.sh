#!/bin/sh
# SPDX-License-Identifier: BSD-3-Clause
# Creates a certificate authority, certificates, and the server's rules (docs/security.md):
#   sh certificates.sh FOLDER HOST [NAME...]        create missing certificates; HOST is the server's name or IPv4
#                                                   address, as clients use it
#   sh certificates.sh --renew FOLDER [NAME...]     new keys and certificates, by default for all
#   sh certificates.sh --revoke FOLDER NAME...      withdraw the rights of certificates
# A NAME is camera.CAMERA for the camera CAMERA, or viewer or operator, or viewer.WHO or operator.WHO for one of
# several; by default viewer and operator. FOLDER/server has the server's certificate and rules, FOLDER/NAME has
# member.json5 and the certificate of NAME. Do not distribute FOLDER/authority.key: it can sign certificates for any role.
set -eu
DAYS=365
configs=$(cd "$(dirname "$0")" && pwd)

fail() {
    echo "error: $1" >&2
    exit 2
}

check() { # NAME: Zenoh's names, and 64 characters with "~9" at the end, which X.509 allows
    case $1 in
    camera) fail "each camera has its own certificate; give camera.NAME, such as camera.north" ;;
    camera.?* | viewer | viewer.?* | operator | operator.?*) ;;
    *) fail "'$1' is no certificate's name; give camera.NAME, viewer, viewer.WHO, operator or operator.WHO" ;;
    esac
    case $1 in *[!A-Za-z0-9_.-]*) fail "'$1': use letters, digits, '_', '.' and '-'" ;; esac
    [ ${#1} -le 62 ] || fail "'$1' has ${#1} characters; a certificate's name has at most 62"
}

common_name() { # NAME: not that of a revoked certificate, because rules grant rights by common names
    number=1 name_now=$1
    while grep -qxF "$name_now" revoked; do
        number=$((number + 1)) name_now=$1~$number
    done
    echo "$name_now"
}

sign() { # NAME EXTENSIONS: replaces the certificate in one step, so that a failure keeps the old one
    rm -rf "$1/new"
    mkdir -p "$1/new"
    openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj "/CN=$(common_name "$1")" \
        -keyout "$1/new/member.key" -out "$1/request" 2>/dev/null
    printf 'basicConstraints=CA:FALSE\n%s\n' "$2" >"$1/extensions"
    openssl x509 -req -in "$1/request" -CA authority.pem -CAkey authority.key -CAcreateserial -days "$DAYS" \
        -extfile "$1/extensions" -out "$1/new/member.pem" 2>/dev/null
    rm "$1/request" "$1/extensions"
    cp authority.pem "$1/new/authority.pem"
    rm -rf "$1/tls"
    mv "$1/new" "$1/tls"
}

sign_member() { # NAME
    if [ "$1" = server ]; then
        host=$(cat host)
        case $host in
        *[!0-9.]*) host="DNS:$host" ;;
        *) host="IP:$host" ;;
        esac
        sign server "extendedKeyUsage=serverAuth,clientAuth
subjectAltName=$host,DNS:localhost,IP:127.0.0.1"
    else
        sign "$1" "extendedKeyUsage=clientAuth"
        cp "$configs/member.json5" "$1"
    fi
}

members() { # ROLE: the names that have a certificate
    for path in "$1"/tls "$1".*/tls; do
        [ ! -f "$path/member.pem" ] || dirname "$path"
    done
}

quoted() { # ROLE: common names for the rules; never an empty list, which would match every client
    { echo "$1" && members "$1"; } | sort -u | while read -r name; do printf '"%s"\n' "$(common_name "$name")"; done |
        paste -sd, -
}

write_rules() {
    mkdir -p server/zenoh
    members camera | while read -r name; do echo "${name#camera.} $(common_name "$name")"; done >cameras
    awk -v viewers="$(quoted viewer)" -v operators="$(quoted operator)" '
        FILENAME == "cameras" { name[++count] = $1; certificate[count] = $2; next }
        /\/\/ each camera/ { inside = 1; block = ""; next }
        /\/\/ end/ {
            for (k = 1; k <= count; k++) {
                text = block
                gsub(/\{camera\}/, name[k], text)
                gsub(/\{certificate\}/, certificate[k], text)
                printf "%s", text
            }
            inside = 0
            next
        }
        inside { block = block $0 "\n"; next }
        { sub(/\["viewer"\]/, "[" viewers "]"); sub(/\["operator"\]/, "[" operators "]"); print }
    ' cameras "$configs/server.json5" >server/zenoh/server.new
    mv server/zenoh/server.new server/zenoh/server.json5
    rm cameras
}

action=create
case ${1:-} in
--renew | --revoke) action=${1#--} && shift ;;
-*) fail "unknown option $1; see the first lines of $0" ;;
esac
[ $# -ge 2 ] || [ "$action$#" = renew1 ] || fail "give FOLDER and more; see the first lines of $0"
folder=$1
shift
umask 077
if [ "$action" = create ]; then
    host=$1
    shift
    [ $# -gt 0 ] || set -- viewer operator
fi
for name; do [ "$action$name" = renewserver ] || check "$name"; done
[ "$action" = create ] || [ -f "$folder/authority.key" ] || fail "$folder/authority.key does not exist; check FOLDER"
mkdir -p "$folder"
cd "$folder"
touch revoked
if [ "$action" = create ]; then
    [ "$host" = "$(cat host 2>/dev/null)" ] || rm -rf server/tls # its certificate names another host
    echo "$host" >host
fi
[ -f authority.key ] || openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 3650 \
    -subj "/CN=roundel authority" -keyout authority.key -out authority.pem 2>/dev/null

case $action in
create)
    for name in server "$@"; do [ -f "$name/tls/member.pem" ] || sign_member "$name"; done
    ;;
renew)
    [ $# -gt 0 ] || set -- server $(members camera) $(members viewer) $(members operator)
    for name; do [ -f "$name/tls/member.pem" ] || fail "$folder has no certificate of $name"; done
    for name; do sign_member "$name"; done
    ;;
revoke)
    for name; do [ -f "$name/tls/member.pem" ] || fail "$folder has no certificate of $name"; done
    for name; do
        common_name "$name" >>revoked
        rm -r "$name"
    done
    ;;
esac
write_rules
