# Default target: the list of targets.

VENV    := .venv
BIN     := $(VENV)/bin
PYTHON  ?= python3
READY   := $(VENV)/.ready
CORE    := $(VENV)/.core
BLE     := .venv-ble
AUDIT   := .venv-audit
NODE    := .node
ARGS    ?=
# More than the cores of a small machine, because most tests wait for programs, servers or a board.
WORKERS ?= 5
INPUTS  ?= 20000
KILLS   ?= 100
NODES   ?= 1 3
HOME_ASSISTANT ?= 2025.2.5
CYCLONEDX := 7.5.0
PROMETHEUS_FOLDER = $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/bms_estimator-prometheus
HA_FOLDER = $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/bms_estimator-home-assistant/$(HOME_ASSISTANT)

# Programs that the tests run: compiler and simulator of the board, a broker, systemd's checks.
APT := gcc gcc-avr avr-libc arduino-core-avr simavr libsimavr-dev libelf-dev influxdb mosquitto mosquitto-clients systemd systemd-container udev chromium qemu-user mmdebstrap libfaketime strace

.DEFAULT_GOAL := help
.PHONY: help venv apt audit check deb deb-arm64 addon docs test test-all prepared collected demo demo-fleet fleet fleet-kills benchmark home-assistant real-home-assistant anywhere month electrochemical bank cells power resolution unseen nats ble chapter5 ablation ablation-weeks forecast load page screenshots fuzz simulate firmware kernels integrations prometheus payloads cell-schema compile-order notebook lock

help: ## this list
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / {printf "make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

venv: $(READY) ## the environment in .venv, from the hash-locked list

$(READY): requirements.lock pyproject.toml
	@.ci/venv "$(PYTHON)" "$(VENV)" requirements.lock
	@touch $(CORE) $@

$(CORE): requirements-core.lock pyproject.toml
	@.ci/venv "$(PYTHON)" "$(VENV)" requirements-core.lock
	@touch $@

apt: ## the Debian packages of the tests: installs missing ones if permitted, otherwise names them
	@.ci/apt $(APT)

check: venv ## style, import order of the layers, number of statements, and types, in seconds
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports --no-logo
	$(BIN)/python .ci/statements.py
	$(BIN)/mypy

test: prepared ## style, types, firmware, and all tests except the redundant and longer ones
	$(BIN)/python -m pytest --numprocesses=$(WORKERS) --dist=loadfile --no-loadscope-reorder -m "not thorough" $(ARGS)

test-all: prepared ## also the redundant and longer tests
	$(BIN)/python -m pytest --numprocesses=$(WORKERS) --dist=loadfile --no-loadscope-reorder $(ARGS)

prepared: apt venv
	@$(MAKE) --no-print-directory --jobs=2 --output-sync kernels check firmware real-home-assistant prometheus collected

# Compiles the test modules once. Otherwise each worker of pytest compiles all of them in a new checkout.
collected:
	@$(BIN)/python -m pytest --collect-only -qq > /dev/null 2>&1 || true # the run of the tests reports errors

demo: $(CORE) ## broker, board and service in one terminal, e.g. make demo ARGS="--seconds 20"
	@$(BIN)/bms-estimator demo $(ARGS)

demo-fleet: venv ## a fleet of 1,000 simulated packs, explained: faulty packs are named, and a worker is killed: a minute
	@$(BIN)/bms-estimator fleet demo $(ARGS)

fleet: venv ## cost of a fleet, in processes on this machine, e.g. make fleet ARGS="--packs 10000 --minutes 5"
	@$(BIN)/python -m tests.benchmarks.fleet.processes $(ARGS)

fleet-kills: venv ## workers and server nodes killed 100 times, with one node and with three, states compared bit by bit: 15 minutes
	for nodes in $(NODES); do KILLS=$(KILLS) NODES=$$nodes $(BIN)/python -m pytest -s --timeout=7200 \
		tests/fleet/worker/test_worker.py -k kills $(ARGS) || exit 1; done

nats: venv ## a node of a NATS cluster killed while messages arrive, in each of its roles: a minute
	CLUSTER=1 $(BIN)/python -m pytest tests/mqtt/test_nats_server.py $(ARGS)

prometheus:
	@.ci/prometheus "$(PROMETHEUS_FOLDER)" || echo "no Prometheus here: its tests are skipped"

real-home-assistant:
	@.ci/home-assistant "$(HOME_ASSISTANT)" "$(HA_FOLDER)" || echo "no real Home Assistant here: its tests are skipped"

home-assistant: apt venv ## tests with the real Home Assistant, installed at the first run: two minutes
	@.ci/home-assistant "$(HOME_ASSISTANT)" "$(HA_FOLDER)"
	HOME_ASSISTANT=$(HOME_ASSISTANT) $(BIN)/python -m pytest -n0 tests/home_assistant $(ARGS)

ble: ## a BMS over Bluetooth with a simulated BlueZ; the extra needs Python 3.12: make ble PYTHON=python3.12
	@[ -x $(BLE)/bin/python ] || $(PYTHON) -m venv $(BLE)
	@$(BLE)/bin/pip install --quiet --disable-pip-version-check -e '.[ble]' pytest pytest-asyncio pytest-timeout
	$(BLE)/bin/python -m pytest -o addopts= --noconftest -rs tests/sources/bluetooth/test_source.py tests/sources/bluetooth/test_client.py $(ARGS)

benchmark: venv ## the table of measured times, rates and memory
	@$(BIN)/python -m tests.benchmarks.speed $(ARGS)

anywhere: venv ## SOC error from any starting point of real captures, e.g. make anywhere ARGS=PF: minutes
	@$(BIN)/python -m tests.benchmarks.anywhere $(ARGS)

month: venv ## SOC error over simulated weeks of use, day by day, e.g. make month ARGS="A123 --days 30 --seeds 1 2": minutes
	@$(BIN)/python -m tests.estimator.month $(ARGS)

electrochemical: venv ## SOC error over a week of cells that PyBaMM simulates, at 0 and 25 °C, e.g. make electrochemical ARGS="Ecker2015 --days 2": half an hour
	@$(BIN)/python -m tests.estimator.month --electrochemical --days 7 $(ARGS)

bank: venv ## the weakest cell of simulated banks: false alarms, detection and error of its SOC: up to 10 minutes
	@$(BIN)/python -m tests.benchmarks.bank $(ARGS)
	@$(BIN)/python -m tests.benchmarks.fleet.failing_packs

cells: venv ## single cells of simulated packs: shorts and false alarms, beside three other detectors: minutes
	@$(BIN)/python -m tests.benchmarks.cells $(ARGS)

forecast: venv ## forecasts of the time to cut-off on real captures, e.g. make forecast ARGS="n10_us06 leaf": half an hour
	@$(BIN)/python -m tests.benchmarks.forecast $(ARGS)

power: venv ## available power, usable capacity and time to full against real captures: two minutes
	@$(BIN)/python -m tests.benchmarks.capability

chapter5: venv ## the experiments of the thesis's chapter 5 on real captures, beside Tables 11 and 13
	@$(BIN)/python -m tests.benchmarks.thesis.chapter5

resolution: venv ## SOC error by rate, steps and delay of a source, simulated, e.g. make resolution ARGS=house: two minutes
	@$(BIN)/python -m tests.benchmarks.resolution $(ARGS)

unseen: venv ## SOC error through kills, restarts and gaps, on real captures: minutes
	@$(BIN)/python -m tests.benchmarks.unseen $(ARGS)

ablation: venv ## ablation of the filter on real captures, e.g. make ablation ARGS=LFP: minutes
	@$(BIN)/python -m tests.benchmarks.ablation $(ARGS)

ablation-weeks: venv ## ablation of the slow fit over simulated weeks, e.g. make ablation-weeks ARGS="solar --parts slow Huber": hours
	@$(BIN)/python -m tests.benchmarks.weeks $(ARGS)

fuzz: venv ## edited inputs to all readers of foreign bytes, e.g. make fuzz INPUTS=1000 ARGS="-k jbd": half an hour
	HYPOTHESIS_MAX_EXAMPLES=$(INPUTS) $(BIN)/python -m pytest --numprocesses=2 --hypothesis-profile=long --timeout=7200 --show-capture=no tests/fuzz $(ARGS)

load: venv ## 5,000 frames/s for 10 min over a PTY, a day of serial bytes, attacks on listeners, alarms and a fleet, wear of the disk, e.g. make load ARGS="--minutes 1 --hours 2"
	@$(BIN)/python -m tests.benchmarks.long_runs.endurance $(ARGS)

audit: ## known vulnerabilities of requirements.lock; exit code of .ci/audit.py 3 where the data cannot be reached
	@[ -x $(AUDIT)/bin/python ] || $(PYTHON) -m venv $(AUDIT)
	@$(AUDIT)/bin/pip install --quiet --disable-pip-version-check pip-audit==2.10.1
	@$(AUDIT)/bin/python .ci/audit.py

page: apt venv ## cost of the live page in a real Chromium at 10 Hz, e.g. make page ARGS=60: minutes
	@$(BIN)/python -m tests.benchmarks.speed.page $(ARGS)

screenshots: apt venv ## the pictures of the live page, of the page of a fleet and of reports in docs
	@$(BIN)/python -m tests.page.screenshots
	@$(BIN)/python -m tests.fleet.page_screenshots
	@$(BIN)/python -m tests.reports.screenshots

simulate: venv ## the whole service simulated: make simulate SEED=5, or many, e.g. make simulate ARGS="--seeds 1000": minutes
	@$(BIN)/python -m tests.world $(if $(SEED),--seed $(SEED)) $(ARGS)

firmware: ## the board's firmware and its simulator, if the compilers are installed
	@if .ci/can-simulate; then $(MAKE) --no-print-directory -C firmware all sim; \
	else echo "firmware not built: it needs $(filter %avr %avr-dev avr-libc libelf-dev,$(APT))"; fi

integrations: apt venv prometheus ## tests with the real Node-RED, AsyncAPI parser, InfluxDB and Prometheus; installs the first two in .node
	@[ -d $(NODE)/node_modules/node-red ] || npm install --prefix $(NODE) --no-audit --no-fund --ignore-scripts node-red@4.1.15 @asyncapi/parser@3.6.3
	$(BIN)/python -m pytest tests/deploy/test_node_red.py tests/deploy/test_asyncapi.py tests/deploy/test_grafana.py \
		tests/deploy/test_telegraf.py tests/sinks/exports/test_influx.py tests/sinks/exports/test_prometheus.py tests/fleet/server/test_metrics.py $(ARGS)

deb: venv ## the Debian package in build/deb, with the program and the packages that it requires: three minutes
	@$(BIN)/python deploy/debian/build.py build/deb

deb-arm64: venv ## the Debian package for arm64 in build/deb-arm64, on any machine: ten minutes
	@$(BIN)/python deploy/debian/build.py build/deb-arm64 --arm64

addon: venv ## a repository with the Home Assistant add-on in build/addon, for a Git server or the folder /addons
	rm -rf build/addon && mkdir -p build/addon && cp deploy/home-assistant/repository.yaml build/addon
	cp -r deploy/home-assistant/addon build/addon/bms_estimator
	$(BIN)/python -m hatchling build --target wheel --directory build/addon/bms_estimator
	version=$$($(BIN)/python -m hatchling version) && sed -i "s/@VERSION@/$${version%+*}/" build/addon/bms_estimator/config.yaml # a tag of Docker has no +

docs: venv ## the documentation as a site in build/site, with checked links
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

payloads: venv ## record the published payloads; rejects an incompatible change within a version
	@$(BIN)/python -m tests.sinks.mqtt.payload_record

cell-schema: venv ## write the JSON schema of `cell convert`
	@$(BIN)/python -m tests.conversion.published_schema

notebook: venv ## execute the notebook of the documentation, and write its outputs
	@$(BIN)/python -m tests.library.notebook

kernels: venv
	$(BIN)/bms-estimator compile

compile-order: venv ## record the order in which a first start compiles the kernels, after a change of their names or arguments: a minute
	folder=$$(mktemp -d) && NUMBA_CACHE_DIR=$$folder $(BIN)/python -m tests.service.compile_order; rm -r $$folder

lock: ## update requirements.lock, requirements-core.lock and the SBOM of the wheel after a change of dependencies (needs uv)
	uv pip compile --quiet --all-extras --group dev --generate-hashes --no-header --universal pyproject.toml -o requirements.lock
	uv pip compile --quiet --generate-hashes --no-header --universal --constraints requirements.lock pyproject.toml -o requirements-core.lock
	uv tool run --quiet --from cyclonedx-bom==$(CYCLONEDX) cyclonedx-py requirements --pyproject pyproject.toml --output-reproducible \
		-o bms_estimator.cdx.json requirements-core.lock
