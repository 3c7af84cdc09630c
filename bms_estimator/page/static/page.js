// The live page, drawn at most four times a second, its curves twice.
import * as f from "./format.js";
import { attribute, changed, hide, listen, node, text } from "./live.js";
import { showWhatIf } from "./what_if.js";
import { Curve, OverSoc, Ring, nullGaps, scaled } from "./charts.js";

const DRAW_MS = 250, CURVES_MS = 500, DESCRIBE_MS = 10_000, HISTORY_MS = 60_000, AHEAD_MS = 86_400_000;
const SPANS = { live: 300, hour: 3600, day: 86400, month: 30 * 86400 }; // [s]
const ROWS = 3600; // of recent states
const COLUMNS = ["voltage_v", "voltage_estimate_v", "current_a", "soc", "soc_std", "innovation_v"];
const MAX_EVENTS = 50;
const MIN_POINT_S = 600; // shortest time to the cut-off that is shown as one number [s]

const $ = (id) => document.getElementById(id);
const number = (x) => typeof x === "number";
const words = (name) => name.replaceAll("_", " ").replace("soc", "SOC");
const clip = (x) => Math.min(Math.max(x, 0), 1);
const packs = new Map();
const ui = { pack: null, span: "live", element: null, drawn: 0, curves: -Infinity, described: -Infinity, due: false };
let stream, link = null, linkSince = 0;


class Pack {
	topics = {};
	recent = new Ring(1 + COLUMNS.length, ROWS);
	learned = {}; // element -> percent of SOC -> [value, std]
	events = [];
	history = {}; // span -> { at, data } or { at, reason }
	stateMs = 0; // arrival of the last state
	since = null; // time of the last state when it became stale
	constructor(name) { this.name = name; }
	take(topic, value) {
		if (topic === "recent") {
			this.recent.clear();
			(value.time_s ?? []).forEach((time, i) => this.recent.push([time, ...COLUMNS.map((c) => value[c]?.[i])]));
			return;
		}
		if (topic === "elements") { this.learned = value; return; }
		if (topic === "event" && value) this.addEvent(value);
		this.topics[topic] = value;
		if (topic === "state" && value) {
			this.stateMs = Date.now();
			const time = Date.parse(value.time);
			if (time < this.stateMs + AHEAD_MS) this.recent.push([time / 1e3, ...COLUMNS.map((c) => value[c])]);
		}
		if (topic === "parameters" && value?.soc != null) {
			for (const [name, p] of Object.entries(value.elements)) {
				if (p.valid && p.std != null) (this.learned[name] ??= {})[Math.round(100 * value.soc)] = [p.value, p.std];
			}
		}
	}
	addEvent(event) {
		if (this.events.some((e) => e.time === event.time && e.name === event.name)) return;
		this.events.push(event);
		this.events.sort((a, b) => Date.parse(b.time) - Date.parse(a.time));
		this.events.length = Math.min(this.events.length, MAX_EVENTS);
	}
	get alarms() { return Object.entries(this.topics).filter(([t, a]) => t.startsWith("alarm/") && a).map(([, a]) => a); }
	get raised() { return this.alarms.some((a) => a.active); }
	/** Reason why the values are not current; "" if they are. */
	get trouble() {
		const { availability, "sensor/availability": sensor, health, state } = this.topics;
		if (!stream.open) return "the page's server does not answer";
		if (link && !link.up) return link.reason;
		if ((availability ?? "online") !== "online") return "the service is offline";
		if ((sensor ?? "online") !== "online") return health?.sensor_message || "the sensor is offline";
		return state && this.stateMs < linkSince ? "no value since the broker was lost" : "";
	}
}

function take(message) {
	for (const [key, value] of Object.entries(message)) {
		const slash = key.indexOf("/"), name = key.slice(0, slash);
		if (key === "link") {
			if (value.up && link?.up === false && packs.size) linkSince = Date.now();
			link = value;
		} else if (key === "packs") {
			for (const gone of packs.keys()) if (!value.names.includes(gone)) packs.delete(gone);
			text($("hidden"), value.hidden ? `${value.hidden} more devices not shown` : "");
		} else {
			if (!packs.has(name)) packs.set(name, new Pack(name));
			packs.get(name).take(key.slice(slash + 1), value);
		}
	}
}

// drawing

function drawSoon() {
	if (ui.due) return;
	ui.due = true;
	setTimeout(() => requestAnimationFrame(draw), Math.max(0, ui.drawn + DRAW_MS - performance.now()));
}

const slots = {};
for (const element of document.querySelectorAll("[data-q]")) slots[element.dataset.q] = element;
const parts = [...document.querySelectorAll("[data-of]")];
const put = (name, value) => text(slots[name], value);

function draw() {
	ui.due = false;
	listPacks();
	const now = performance.now(), pack = packs.get(ui.pack);
	ui.drawn = now;
	drawStatus(pack);
	hide($("empty"), !!pack);
	hide($("pack"), !pack);
	if (!pack) return;
	const state = pack.topics.state ?? {};
	drawHead(pack);
	showWhatIf(link || !number(state.soc) ? null : pack.name); // a dashboard, which has a link to a broker, makes no forecasts
	drawAlarms(pack);
	drawState(state);
	drawCells(state);
	drawRanks(pack.topics.cells);
	drawParameters(pack.topics.parameters);
	drawHealth(pack);
	drawEvents(pack);
	if (now - ui.curves >= CURVES_MS) {
		ui.curves = now;
		drawCurves(pack);
		drawForecast(pack);
		drawElement(pack);
	}
	if (now - ui.described >= DESCRIBE_MS) {
		ui.described = now;
		describe(pack);
	}
}

function drawStatus(pack) {
	const { state } = pack?.topics ?? {}, trouble = pack ? pack.trouble : link?.reason ?? "";
	let kind = "wait", label = pack ? "waiting for a sample" : stream.open ? "waiting for a pack" : "connecting";
	if (trouble) {
		kind = "stale";
		label = "no value yet";
		if (state) {
			pack.since ??= new Date(state.time);
			label = `stale since ${f.clock(pack.since)}`;
		}
	} else if (state) {
		kind = "live";
		label = "live";
		pack.since = null;
	}
	text($("status").lastElementChild, label);
	attribute($("status"), "data-state", kind);
	attribute(document.body, "data-state", kind);
	text($("why"), trouble);
	hide($("why"), !trouble);
	const title = [kind === "stale" && "stale", number(state?.soc) && `${f.percent(state.soc, 0)} %`, pack?.name].filter(Boolean).join(" · ");
	if (document.title !== title) document.title = title || "bms_estimator";
}

function drawHead(pack) {
	const { info, state } = pack.topics;
	text($("name"), pack.name);
	const facts = info ? [info.cell, `${info.series_count} in series`, f.volts(info.nominal_voltage_v), f.ampereHours(info.capacity_ah)] : [];
	text($("what"), [...facts, state && `as of ${f.clock(new Date(state.time))}`].filter(Boolean).join(" · "));
	for (const tab of $("packs").children) {
		const here = tab.dataset.pack === pack.name;
		attribute(tab, "aria-selected", String(here));
		tab.tabIndex = here ? 0 : -1;
		const { raised, trouble } = packs.get(tab.dataset.pack);
		attribute(tab, "data-state", trouble ? "stale" : "live");
		attribute(tab, "class", raised ? "raised" : "");
	}
}

function drawAlarms({ alarms, topics }) {
	const active = alarms.filter((a) => a.active || (a.watched === false && topics.health?.sensor_online !== false));
	active.sort((a, b) => (a.severity < b.severity ? -1 : 1));
	if (changed($("alarms"), JSON.stringify(active))) $("alarms").replaceChildren(...active.map(alarmRow));
}

function alarmRow(a) {
	const of = (x, label) => (number(x) ? `${label}${f.digits(x)} ${a.unit ?? ""}`.trim() : "");
	const facts = [a.severity, of(a.value, ""), of(a.limit, "limit "), a.since && `since ${f.when(new Date(a.since))}`, a.latched && "latched", a.watched === false && "cannot be watched"];
	return node("div", { class: `alarm ${a.severity}`, "data-alarm": a.name },
		node("b", {}, words(a.name)), node("span", {}, a.text || a.unwatched_reason), node("small", {}, facts.filter(Boolean).join(" · ")));
}

const SHOWN = {
	voltage_v: f.volts, voltage_estimate_v: f.volts, current_a: f.amperes, power_w: f.watts, temperature_c: f.celsius,
	innovation_v: f.millivolts, usable_capacity_ah: f.ampereHours, remaining_energy_wh: f.wattHours, remaining_capacity_ah: f.ampereHours,
	energy_out_kwh: (x) => f.wattHours(1e3 * x), energy_in_kwh: (x) => f.wattHours(1e3 * x), soc: f.percent, weakest_cell_soc: f.percent, stability_margin: f.percent,
};

/** Time to the cut-off, or while charging to full, with its 90 % band. Below ten minutes a single load peak decides, so only the band is shown. */
function timeLeft(s) {
	const { time_to_cutoff_s: median, time_to_cutoff_p05_s: early, time_to_cutoff_p95_s: late } = s;
	if (!number(median)) return ["To full", f.duration(s.time_to_full_s), ""];
	const band = f.durations(early, late);
	if (median >= MIN_POINT_S) return ["To cut-off", f.duration(median), `90 % band ${band}`];
	return ["To cut-off", band, `90 % band; ${f.percent(s.cutoff_within_5min, 0)} % within 5 min`];
}

function drawState(s) {
	const time = s.time_to_cutoff_s ?? s.time_to_full_s, [label, left, band] = timeLeft(s);
	for (const [name, show] of Object.entries(SHOWN)) put(name, show(s[name]));
	for (const part of parts) hide(part, !number(part.dataset.of === "time_left" ? time : s[part.dataset.of]));
	put("soc_std", f.percent(number(s.soc_std) ? 2 * s.soc_std : null));
	put("weakest_cell_soc_std", f.percent(number(s.weakest_cell_soc_std) ? 2 * s.weakest_cell_soc_std : null));
	put("time_left", left);
	put("time_left_label", label);
	put("time_left_band", band);
	drawForecastValues(s);
	put("way", s.current_a > 0 ? "discharging" : s.current_a < 0 ? "charging" : "at rest");
	put("lock", `${s.lock ? "in lock" : "no lock"}, ${s.converged ? "converged" : "converging"}`);
	if (number(s.soc)) drawScale(s);
}

function drawScale(s) {
	const known = [s.delta_1, s.delta_2].filter(number), stop = Math.max(0, ...known), band = 2 * (s.soc_std ?? 0);
	const place = (id, name, x) => {
		const value = `${(100 * clip(x)).toFixed(2)}%`, element = $(id);
		if (element[name] !== value) element.style[name] = element[name] = value;
	};
	place("fill", "width", s.soc - band);
	place("band", "left", s.soc - band);
	place("band", "width", clip(s.soc + band) - clip(s.soc - band));
	place("at", "left", s.soc);
	hide($("stopmark"), !known.length);
	for (const [id, x] of [["stop", stop], ["stopmark", stop], ["d1", s.delta_1], ["d2", s.delta_2]]) place(id, id === "stop" ? "width" : "left", x ?? 0);
	attribute($("stopmark"), "class", stop > 0.5 ? "left" : "");
	put("stop", f.percent(stop));
	put("deltas", [s.delta_1, s.delta_2].map((d, i) => number(d) && `δ${"₁₂"[i]} ${f.percent(d)} %`).filter(Boolean).join(", "));
	attribute($("fill"), "class", s.soc <= Math.max(stop, 0.1) ? "bad" : s.soc < 0.2 ? "low" : "");
	attribute($("scale"), "aria-valuenow", String(Math.round(100 * s.soc)));
	attribute($("scale"), "aria-valuetext", `${f.percent(s.soc, 0)} %, give or take ${f.percent(band, 0)} %; stop discharging at ${f.percent(stop, 0)} %`);
}

// cells

function drawCells(s) {
	const cells = Array.isArray(s.cells_v) ? s.cells_v : [], known = cells.filter(number), count = known.length;
	hide($("cellcard"), !count);
	attribute($("pack"), "class", count ? "withcells" : "");
	if (!count) return;
	const low = Math.min(...known), high = Math.max(...known), mean = known.reduce((a, b) => a + b) / count;
	const first = cells.indexOf(low), last = cells.indexOf(high);
	const reach = Math.max(high - low, 0.04), floor = Math.max(low - reach, 0), roof = high + 0.25 * reach, bars = $("cells");
	while (bars.childElementCount > cells.length) bars.lastChild.remove();
	while (bars.childElementCount < cells.length) {
		bars.append(node("li", { role: "img" }, node("b", {}), node("div", { class: "cellbar" }, node("i", {})), node("small", {}), node("span", {}, String(bars.childElementCount + 1))));
	}
	attribute(bars, "class", count > 16 ? "many" : "");
	cells.forEach((v, i) => {
		const item = bars.children[i], [value, box, apart] = item.children, measured = number(v);
		const rank = low === high ? "" : i === first ? "lowest" : i === last ? "highest" : "";
		text(value, f.fixed(v, 3));
		text(apart, measured ? f.fixed(1e3 * (v - mean), 0) : "");
		const scale = measured ? ((v - floor) / (roof - floor)).toFixed(3) : "0";
		if (changed(item, scale)) box.firstChild.style.transform = `scaleY(${scale})`;
		attribute(item, "class", rank);
		attribute(item, "aria-label", `cell ${i + 1}: ${measured ? `${v.toFixed(3)} V` : "not measured"}${rank && `, ${rank}`}`);
	});
	put("cellspread", `${count} measured · deviations in mV`);
	put("celllow", `${low.toFixed(3)} V · cell ${first + 1}`);
	put("cellhigh", `${high.toFixed(3)} V · cell ${last + 1}`);
	put("cellmean", `${mean.toFixed(3)} V`);
	put("cellapart", f.millivolts(high - low));
	put("celldev", f.millivolts(Math.sqrt(known.reduce((a, b) => a + (b - mean) ** 2, 0) / count)));
}

/** Draw the cells, the one with the lowest SOC first. */
function drawRanks(report) {
	const cells = Array.isArray(report?.cells) ? report.cells.filter((c) => number(c?.soc)) : [];
	hide($("cellranks"), !cells.length);
	if (!cells.length || !changed($("cellranks"), report)) return;
	const ranked = cells.sort((a, b) => a.soc - b.soc), [weakest] = ranked;
	put("weakestcell", `cell ${weakest.number}, SOC ${f.percent(weakest.soc)} ± ${f.percent(2 * weakest.soc_std)} %`);
	$("cellranks").querySelector("tbody").replaceChildren(...ranked.map((c) => node("tr", { "data-cell": c.number },
		node("th", { scope: "row" }, String(c.number)),
		...[f.percent(c.soc), f.percent(c.soc_std), f.percent(c.resistance_ratio, 0), f.percent(c.capacity_ratio, 0), f.digits(1e3 * c.self_discharge_a, 2)].map((x) => node("td", {}, x)),
		node("td", { class: c.fault ? "bad" : "" }, c.fault ?? ""))));
}

// parameters, health, events

const ELEMENTS = {
	r_s_ohm: ["Rₛ", 1e3, "mΩ"], r_ts_ohm: ["Rₜₛ", 1e3, "mΩ"], c_ts_farad: ["Cₜₛ", 1, "F"], r_tl_ohm: ["Rₜₗ", 1e3, "mΩ"],
	c_tl_farad: ["Cₜₗ", 1, "F"], e_o_v: ["E₀", 1, "V"],
};
const HEALTH = { capacity: ["Capacity, of new", 100, "%"], r_s: ["Rₛ, of new", 100, "%"], current_offset_a: ["Current offset", 1e3, "mA"] };
const rows = new Map();

function drawParameters(report) {
	if (!report || !changed(rows, report)) return;
	const all = Object.entries({ elements: ELEMENTS, state_of_health: HEALTH, a: {} }).flatMap(([group, names]) =>
		Object.entries(report[group] ?? {}).map(([key, p]) => [`${group} ${key}`, names[key] ?? [words(key), 1, "SI"], p]));
	const kept = new Set(all.map(([key]) => key));
	for (const [key, row] of rows) if (!kept.has(key)) { row.remove(); rows.delete(key); }
	for (const [key, [name, factor, unit], p] of all) {
		if (!rows.has(key)) {
			rows.set(key, node("tr", { "data-p": key }, node("th", { scope: "row" }, name), ...Array.from({ length: 5 }, () => node("td", {}))));
			$("params").append(rows.get(key));
		}
		const texts = [...f.withError(p.value, p.std, factor), unit, p.valid ? "✓ yes" : "no",
			p.valid ? p.source + (p.updated ? `, ${f.clock(new Date(p.updated))}` : "") : p.reason ?? ""];
		const cells = [...rows.get(key).children].slice(1);
		cells.forEach((cell, i) => text(cell, texts[i]));
		attribute(cells[3], "class", p.valid ? "good" : "");
	}
}

function drawHealth({ topics: { health: h, info, state } }) {
	if (!h) return;
	const faults = [h.sensor_message, ...(h.suspects ?? [])].filter(Boolean);
	if (changed($("suspects"), faults.join("\n"))) {
		$("suspects").replaceChildren(...(faults.length ? faults.map((w) => node("li", { class: "bad" }, w)) : [node("li", { class: "good" }, "Nothing is suspected of the input.")]));
	}
	const of = (x, unit) => number(x) && `${f.digits(x, 3)} ${unit}`;
	const facts = {
		Sensor: h.sensor_online ? "online" : "offline", "Sample rate": of(state?.sample_rate_hz, "Hz"), Frames: h.line?.frames_received,
		"Frames lost": h.line?.frames_lost, "Wrong checksums": h.line?.crc_errors, "Line reopened": h.reconnects,
		"Latency, median": of(1e3 * h.loop?.latency_p50_s || null, "ms"), "Board's clock": of(h.clock_ppm, "ppm"), Broker: h.broker_trouble,
		"Waiting for it": h.publish_waiting, Disk: h.store_trouble, Checkpoint: h.checkpoint, "Running for": f.duration(h.uptime_s),
		Crashes: h.total?.crashes, Version: info?.version,
	};
	for (const [name, value] of Object.entries(facts)) {
		const row = (drawHealth[name] ??= $("facts").appendChild(node("div", {}, node("dt", {}, name), node("dd", {}))));
		hide(row, !value && value !== 0);
		text(row.lastChild, number(value) ? value.toLocaleString("en") : value || "");
	}
}

function drawEvents(pack) {
	hide($("eventcard"), !pack.events.length);
	if (!changed($("events"), `${pack.name} ${pack.events.length} ${pack.events[0]?.time}`)) return;
	$("events").replaceChildren(...pack.events.map((e) => node("li", {},
		node("time", { datetime: e.time }, f.when(new Date(e.time))), node("b", {}, words(e.name)), node("span", {}, e.text))));
}

// curves

let curves = null;

function makeCurves() {
	const make = (title, unit, color, minSpan, more) => new Curve($("curves"), { title, unit, color, minSpan, height: 132, ...more });
	curves = {
		soc: make("State of charge", "%", "--soc", 2, { low: 0, high: 100 }),
		v: make("Voltage", "V", "--volt", 0.02, { second: { color: "--estimate", label: "estimated", dash: [5, 3] } }),
		i: make("Current", "A", "--amp", 0.02),
		inno: make("Innovation", "mV", "--inno", 2),
		temp: make("Temperature", "°C", "--inno", 2),
	};
}

function drawCurves(pack) {
	if (!curves) makeCurves();
	const live = ui.span === "live";
	if (!live) loadHistory(pack, ui.span);
	const past = pack.history[ui.span];
	const reason = live ? "" : past?.reason ?? (past?.data?.time_s.length ? "" : past?.data ? "Nothing was recorded in this span." : "reading…");
	text($("nohistory"), reason);
	hide($("nohistory"), !reason);
	hide($("curves"), !!reason);
	if (reason) return;
	const columns = live ? liveColumns(pack) : (past.columns ??= pastColumns(past.data));
	const { time } = columns, end = live ? time.at(-1) ?? Date.now() / 1e3 : Date.now() / 1e3;
	const from = live ? Math.max(end - SPANS.live, Math.min(time[0] ?? end, end - 30)) : end - SPANS[ui.span];
	for (const [name, chart] of Object.entries(curves)) {
		const drawn = columns[name];
		hide(chart.box, !drawn?.[2].some((v) => v !== null));
		if (drawn?.[3]) hide(chart.box.querySelector(".estimate"), !live);
		if (!chart.box.hidden) chart.draw([time, ...drawn], from, end);
	}
}

let forecast = null;

/** Curves of the forecast: SOC and voltage with their 90 % bands, and the probability that the load is still on. */
function drawForecast({ topics: { forecast: report, state } }) {
	const known = number(state?.time_to_cutoff_s), hasCurves = known && !!report?.elapsed_s?.length;
	hide($("forecastcard"), !known && !state?.forecast_reason);
	text($("noforecast"), !known ? `No time to the cut-off: ${state?.forecast_reason}.` : hasCurves ? "" : "The curves follow within a minute.");
	hide($("noforecast"), hasCurves);
	hide($("forecast"), !hasCurves);
	put("forecast_note", hasCurves ? `of ${f.clock(new Date(report.time))}, under a load like the one seen; shaded: 90 %` : "");
	if (!hasCurves) return;
	if (!forecast) {
		const make = (title, unit, color, minSpan, more) => new Curve($("forecast"), { title, unit, color, minSpan, height: 132, sync: "forecast", ...more });
		forecast = {
			v: make("Voltage", "V", "--volt", 0.02, { first: "median", second: { color: "--bad", label: "cut-off", dash: [5, 3] } }),
			soc: make("State of charge", "%", "--soc", 2, { low: 0, high: 100 }),
			on: make("Load still on, probability", "%", "--amp", 200, { low: 0, high: 100 }),
		};
	}
	const start = Date.parse(report.time) / 1e3, time = report.elapsed_s.map((s) => start + s), no = nulls(time);
	const fan = (name, unit, factor) => ["p95", "p05", "p50"].map((q) => scaled(report[`${name}_${q}${unit}`] ?? [], factor));
	const columns = { v: [...fan("voltage", "_v", 1), time.map(() => report.cutoff_v)], soc: fan("soc", "", 100), on: [no, no, scaled(report.survival ?? [], 100)] };
	for (const [name, chart] of Object.entries(forecast)) chart.draw([time, ...columns[name]], time[0], time.at(-1));
}

function drawForecastValues(s) {
	const both = (name) => `${f.watts(s[`${name}_10s_w`])}, ${f.watts(s[`${name}_60s_w`])}`;
	put("cutoff_within", [2, 5, 15].map((minutes) => `${f.percent(s[`cutoff_within_${minutes}min`], 0)} %`).join(", "));
	put("discharge_power", both("available_discharge_power"));
	put("charge_power", both("available_charge_power"));
}

const nulls = (time) => new Array(time.length).fill(null);
/** Upper edge, lower edge and value of the SOC [%]. */
function socColumns(soc, std) {
	const edge = (sign) => Array.from(soc, (v, i) => (Number.isFinite(v) && Number.isFinite(std[i]) ? 100 * clip(v + sign * 2 * std[i]) : null));
	return [edge(1), edge(-1), scaled(soc, 100)];
}

function liveColumns(pack) {
	const [time, v, estimate, i, soc, std, inno] = pack.recent.views(pack.recent.last - SPANS.live), no = nulls(time);
	return { time, v: [no, no, nullGaps(v), nullGaps(estimate)], i: [no, no, nullGaps(i)], soc: socColumns(soc, std), inno: [no, no, scaled(inno, 1e3)] };
}

/** Columns of a history, with a gap after 2.5 steps without a row. */
function pastColumns(data) {
	const at = [];
	data.time_s.forEach((t, i) => { if (i && t - data.time_s[i - 1] > 2.5 * data.step_s) at.push(-1); at.push(i); });
	const pick = (name) => at.map((i) => data[name][i] ?? null), no = nulls(at);
	const span = (name, unit) => [pick(`${name}_max_${unit}`), pick(`${name}_min_${unit}`), pick(`${name}_${unit}`)];
	const time = at.map((i, n) => (i < 0 ? data.time_s[at[n - 1]] + data.step_s : data.time_s[i]));
	return { time, v: [...span("voltage", "v"), no], i: span("current", "a"), soc: socColumns(pick("soc"), pick("soc_std")), temp: [no, no, pick("temperature_c")] };
}

async function loadHistory(pack, span) {
	const before = pack.history[span];
	if (before && Date.now() - before.at < HISTORY_MS) return;
	pack.history[span] = { ...before, at: Date.now() };
	let result = before?.data ? { data: before.data } : { reason: "The page's server does not answer." };
	try {
		const answer = await fetch(`/history?pack=${encodeURIComponent(pack.name)}&span=${span}`);
		result = answer.ok ? { data: await answer.json() } : { reason: "No history is kept here: it lies where the pack's service runs." };
	} catch { /* the status shows it, too */ }
	for (const e of result.data?.events ?? []) pack.addEvent({ ...e, time: new Date(1e3 * e.time_s).toISOString() });
	pack.history[span] = { at: Date.now(), ...result };
	redrawAll();
}

function describe(pack) {
	for (const chart of Object.values(forecast ?? {})) chart.describe("forecast");
	for (const chart of Object.values(curves ?? {})) chart.describe(ui.span === "live" ? "last five minutes" : `last ${ui.span}`);
	const p = pack.topics.parameters?.elements?.[ui.element], [name, factor, unit] = ELEMENTS[ui.element] ?? [];
	if (!p || !name) return;
	const [value, std] = f.withError(p.value, p.std, factor);
	attribute($("elementchart"), "aria-label", `${name} over state of charge, now ${value} ${unit}${std && `, standard deviation ${std} ${unit}`}`);
}

// elements over SOC: functions (2.5)-(2.9) of Chen and Mora, and learned values with errors

// number of the first of three coefficients a1..a15, sign of its term
const FORM = { r_ts_ohm: [1, 1], r_tl_ohm: [4, 1], c_ts_farad: [7, -1], c_tl_farad: [10, -1], r_s_ohm: [13, 1] };
const GRID = Array.from({ length: 101 }, (_, i) => i);
let overSoc = null;

function drawElement(pack) {
	const report = pack.topics.parameters, names = Object.keys(report?.elements ?? {}).filter((n) => n in FORM || (n === "e_o_v" && report.ocv));
	hide($("elementcard"), !names.length);
	if (!names.length) return;
	if (changed($("element"), names.join())) {
		$("element").replaceChildren(...names.map((n) => node("option", { value: n }, `${ELEMENTS[n][0]} [${ELEMENTS[n][2]}]`)));
		if (!names.includes(ui.element)) ui.element = names[0];
		$("element").value = ui.element;
	}
	const name = ui.element, [label, factor] = ELEMENTS[name], p = report.elements[name], { soc, ocv } = report;
	overSoc ??= new OverSoc($("elementchart"), 236);
	const now = number(soc) && number(p.value) ? { soc: 100 * soc, value: factor * p.value, std: factor * (p.std ?? 0) } : null;
	if (name === "e_o_v") {
		const edge = (sign) => ocv.ocv_v.map((v, i) => v + sign * 2 * ocv.std_v[i]);
		overSoc.draw([scaled(ocv.soc, 100), edge(1), edge(-1), ocv.ocv_v, nulls(ocv.soc)], now);
		text($("elementnote"), "Open-circuit voltage at 25 °C, ± 2 std.");
		return;
	}
	const at = GRID.map((i) => pack.learned[name]?.[i]), seen = at.filter(Boolean).length;
	const edge = (sign) => at.map((l) => (l ? factor * Math.max(l[0] + sign * 2 * l[1], 0) : null));
	overSoc.draw([GRID, edge(1), edge(-1), edge(0), curveOf(report.a, name, factor)], now);
	text($("elementnote"), `Dashed: ${label} as a₁…a₁₅ have it. ${seen ? `Band: learned, ± 2 std, where the pack has been since this page is served.` : "Not known well enough yet for a band."}`);
}

/** a e^(-b soc) + c, with -a for a capacitance; null where it is not positive. */
function curveOf(a, name, factor) {
	const [first, sign] = FORM[name], [p, q, r] = [0, 1, 2].map((i) => a?.[`a${first + i}`]?.value);
	const value = (soc) => sign * p * Math.exp(-q * soc) + r;
	return GRID.map((i) => (value(i / 100) > 0 ? factor * value(i / 100) : null));
}

// user input

function redrawAll() { ui.curves = ui.described = -Infinity; drawSoon(); }

/** List packs, those with a raised alarm first. */
function listPacks() {
	const names = [...packs.keys()].sort((a, b) => packs.get(b).raised - packs.get(a).raised || (a < b ? -1 : 1));
	if (!changed($("packs"), names.join())) return;
	const wanted = decodeURIComponent(location.hash.slice(1)), focused = document.activeElement.dataset.pack;
	$("packs").replaceChildren(...names.map((name) => {
		const tab = node("button", { type: "button", role: "tab", "data-pack": name, "aria-controls": "pack" }, name);
		tab.onclick = () => choose(name);
		return tab;
	}));
	[...$("packs").children].find((tab) => tab.dataset.pack === focused)?.focus();
	hide($("packs"), names.length < 2);
	$("name").classList.toggle("hide", names.length > 1);
	if (!packs.has(ui.pack) || names.includes(wanted)) ui.pack = names.includes(wanted) ? wanted : names[0];
}

function choose(name) {
	ui.pack = name;
	history.replaceState(null, "", `#${encodeURIComponent(name)}`);
	redrawAll();
}

$("packs").onkeydown = (event) => {
	const tabs = [...$("packs").children], count = tabs.length, here = tabs.indexOf(document.activeElement);
	const next = { ArrowRight: here + 1, ArrowDown: here + 1, ArrowLeft: here - 1, ArrowUp: here - 1, Home: 0, End: -1 }[event.key];
	if (next === undefined) return;
	const tab = tabs[(next + count) % count];
	event.preventDefault();
	tab.focus();
	choose(tab.dataset.pack);
};
$("spans").onchange = (event) => { ui.span = event.target.value; redrawAll(); };
$("element").onchange = (event) => { ui.element = event.target.value; redrawAll(); };
onresize = redrawAll;
matchMedia("(prefers-color-scheme: dark)").onchange = () => {
	for (const chart of [...Object.values(curves ?? {}), ...Object.values(forecast ?? {}), overSoc]) chart?.plot.redraw(false, true);
};
setInterval(drawSoon, 1000);
stream = listen(take, drawSoon);
