#!/bin/sh
# Runs inside the container as root: installs the package and the service, exposes it to faults, upgrades and removes it.
# The report has a headline with the name of each part. test_boot.py checks the report.
part() { echo "== $1"; }
until_true() { # reports a timeout, which the tests detect
    for _ in $(seq 300); do eval "$1" >/dev/null 2>&1 && return; sleep 0.1; done
    echo "never true: $1"
}
show() { systemctl show bms-estimator -p ActiveState,NRestarts,Result,StatusText,User; }
main_pid() { systemctl show "${1:-bms-estimator}" -P MainPID; }
# runs commands of the documentation, with the replaced programs of boot.py first in the path
run_page() { PATH="/root/bin:$PATH" bash -ex "$1"; }
lines() { journalctl --no-pager -o cat -u "${1:-bms-estimator}"; }
traces() { # files of the service outside the program's package
    find /etc /usr/local /opt /var/lib /var/cache -xdev -path /var/lib/dpkg -prune -o -path /opt/packages -prune -o -name "*bms-estimator*" -printf "%u %p\n"
    id bms-estimator 2>&1 | tr -d "\047‘’"
}
# next message of topic $1; with -R messages that the broker has stored are skipped
receive() { timeout 60 mosquitto_sub -v -C 1 -u dashboard -P two -t "bms/pack/$1" $2; }
snapshot() { # data that an upgrade keeps or continues
    sha256sum /etc/bms-estimator/*
    systemctl is-enabled bms-estimator bms-estimator@second
    find /var/lib/bms-estimator -type f | sort
    bms-estimator history /etc/bms-estimator/pack.toml --folder /var/lib/bms-estimator --events
    receive health -R
    receive state -R
    receive info
    bms-estimator --version
}
# edits settings and unit, and upgrades the running services by the commands $2; $1 is the name of the part
upgrade() {
    echo "# edited" | tee -a /etc/bms-estimator/pack.toml >>/etc/systemd/system/bms-estimator.service
    until_true 'receive state -R'
    part "$1_before"
    snapshot
    part "$1"
    mosquitto_sub -u dashboard -P two -t bms/pack/state >/run/states &
    subscriber=$!
    first=$(main_pid) second=$(main_pid bms-estimator@second)
    eval "$2"
    echo "exit code $?"
    until_true "systemctl is-active bms-estimator && [ \$(main_pid) != $first ]"
    until_true "systemctl is-active bms-estimator@second && [ \$(main_pid bms-estimator@second) != $second ]"
    until_true 'receive info | grep -q "\"version\": *\"$(bms-estimator --version | cut -d " " -f 2)\""'
    show
    grep -c "# edited" /etc/bms-estimator/pack.toml /etc/systemd/system/bms-estimator.service
    lines | grep "restored: SOC" | tail -n 1
    part "$1_after"
    snapshot
    kill $subscriber
    sed -E 's/.*"publish_time":"([^"]+)".*"soc":([^,]+),.*/published \1 \2/' /run/states
}
cache=/var/cache/bms-estimator

part install
ln -s /opt/packages/current /root/package
mosquitto_passwd -b /root/bms.passwd pack "$(cat /root/house/mqtt-password)"
mosquitto_passwd -b /root/bms.passwd second "$(cat /root/house/mqtt-password)"
mosquitto_passwd -b /root/bms.passwd dashboard two
systemd-run --quiet --unit=broker mosquitto -c /root/bms.conf
cd /root/house && head -n 1 /root/install >/root/install-package && tail -n +2 /root/install >/root/install-service
run_page /root/install-package
# a simulated board, which prints the path of its line
systemd-run --quiet --unit=board sh -c \
    'bms-estimator simulate --cell chen_mora --rate-hz 10 >/run/board'
until_true 'grep -q /dev/pts/ /run/board'
chgrp dialout "$(cat /run/board)" && chmod 660 "$(cat /run/board)" && mkdir /dev/bms && ln -s "$(cat /run/board)" /dev/bms/board
run_page /root/install-service

part first
until_true "ls $cache/*/*"
until_true 'journalctl -u bms-estimator | grep -q "port opened"'
until_true 'timeout 5 mosquitto_sub -C 1 -u dashboard -P two -t bms/pack/state'
show
systemctl is-enabled bms-estimator
systemctl show bms-estimator -p WatchdogUSec
grep -E "^(Uid|NoNewPrivs|Seccomp|CapEff):" "/proc/$(main_pid)/status"
tr '\0' '\n' <"/proc/$(main_pid)/environ" | grep BMS_BOOT_ID
echo "compiled $(find $cache -name "*.nbc" | wc -l)"
# in the mount namespace of the service
nsenter -t "$(main_pid)" -m sh -c 'ls -A /home /root; touch /root/x /etc/x' 2>&1

# each of the next four counts must be 0
part secret
secret=$(cat /root/house/mqtt-password)
lines | grep -c "$secret"
tr '\0' '\n' <"/proc/$(main_pid)/environ" | grep -c "$secret"
ps -eo args | grep -v grep | grep -c "$secret"
timeout 5 mosquitto_sub -C 2 -u dashboard -P two -t bms/pack/health -t bms/pack/info | grep -c "$secret"

part watchdog
# by this file systemd-timesyncd reports a synchronized clock, which the restarted service must see
mkdir -p /run/systemd/timesync && touch /run/systemd/timesync/synchronized
# a stopped process does not notify the watchdog
kill -STOP "$(main_pid)"
until_true 'systemctl show bms-estimator -P NRestarts | grep -qx 1 && systemctl is-active bms-estimator'
show

part second
systemctl stop bms-estimator
systemctl show bms-estimator -p Result
ls /var/lib/bms-estimator
cp /root/second.toml /etc/bms-estimator/
systemctl start bms-estimator@second
systemctl show bms-estimator@second -p StatusText
ls -d $cache/* | wc -l
systemctl stop bms-estimator@second

# the state folder becomes a full file system; chrony appears, for which the installation adds a drop-in
part full
mount -t tmpfs -o size=4k,mode=700 none /var/lib/bms-estimator
dd if=/dev/zero of=/var/lib/bms-estimator/full bs=4k count=1 status=none
touch /usr/sbin/chronyd
bms-estimator install
until_true 'timeout 5 mosquitto_sub -C 1 -u dashboard -P two -t bms/pack/health | grep -q "No space left"'
show
systemctl stop bms-estimator
umount /var/lib/bms-estimator

systemctl start bms-estimator
systemctl enable --quiet --now bms-estimator@second
cp -a /usr/lib/bms-estimator /root/program
ln -sfn /opt/packages/next /root/package
upgrade deb "run_page /root/install-package"

part journal
lines
lines bms-estimator@second

part remove
run_page /root/remove
traces

part purge
run_page /root/purge
traces

# a program in a home folder, which the service cannot read there
part home
/root/program/bin/python3 /root/program/bin/bms-estimator install /root/house/pack.toml
show
systemctl show bms-estimator -p ExecStart
cp /root/second.toml /etc/bms-estimator/
systemctl enable --quiet --now bms-estimator@second
systemctl disable --quiet bms-estimator
upgrade pip "PYTHONPATH=/root/pip /root/program/bin/python3 -m pip install --no-index --upgrade /opt/packages/next/*.whl &&
    /root/program/bin/bms-estimator install"

part uninstall
bms-estimator uninstall --purge
traces
