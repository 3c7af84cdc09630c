// Page of a fleet. An overview arrives every 2 s and is drawn at once. Details of a pack are requested when the user
// chooses it.
import { $, attribute, changed, hide, node, text } from "./dom.js";
import * as f from "./format.js";
import { listen } from "./live.js";

const REFRESH_MS = 5000; // refresh interval of the displayed pack
const MAX_LAG_S = 60; // a larger lag is marked as wrong
const MAX_LISTED = 20; // packs in a list
const COLORS = 8; // classes c0 to c7 of fleet.css
const count = (n) => n.toLocaleString("en");
const counted = (n, one, more = `${one}s`) => `${count(n)} ${n === 1 ? one : more}`;
// missing values give an empty text or a dash
const duration = (s) => (f.isNumber(s) ? f.duration(s) : "");
const seconds = (s) => (f.isNumber(s) ? (s < 9.95 ? `${f.fixed(s, 1)} s` : f.duration(s)) : "–");
const rate = (x) => (f.isNumber(x) ? count(x < 9.95 ? Math.round(10 * x) / 10 : Math.round(x)) : "");

// last messages, their arrival [ms], and the user's choices
const ui = {
	fleet: null, fleetAt: 0, // overview
	link: null, linkUpAt: 0, // state of the connection between page server and fleet server
	answers: null, // query results
	staleSince: null, type: null, kind: "all", pack: null,
};

function receive(message) {
	if (message.link) {
		if (message.link.up && !ui.link?.up) ui.linkUpAt = Date.now();
		ui.link = message.link;
	}
	if (message.answers) ui.answers = message.answers;
	if (message.fleet) [ui.fleet, ui.fleetAt] = [message.fleet, Date.now()];
}

/** Reason for which the displayed values are outdated; "" if they are current. */
function trouble() {
	if (!stream.open) return ui.fleet ? "the page's server does not answer" : "";
	if (ui.link && !ui.link.up) return ui.link.reason;
	return "";
}

// drawing

const slots = {};
for (const element of document.querySelectorAll("[data-q]")) slots[element.dataset.q] = element;
const put = (name, value) => text(slots[name], value);

function draw() {
	drawStatus();
	hide($("empty"), !!ui.fleet);
	hide($("fleet"), !ui.fleet);
	if (!ui.fleet) return;
	const { packs, types, soc_std_edges, concerns, time } = ui.fleet;
	text($("what"), `${counted(packs.known, "pack")} of ${counted(types.length, "type")} · as of ${f.clock(new Date(time))}`);
	drawTiles(ui.fleet);
	drawTypes(types);
	drawSpread(types, soc_std_edges, packs.uncertain);
	drawConcerns(concerns);
	drawWorkers(ui.fleet);
	drawAnswers(ui.answers);
}

function drawStatus() {
	const why = trouble(), waits = !why && (!ui.fleet || ui.fleetAt < ui.linkUpAt);
	let state = waits ? "wait" : "live", label = !stream.open ? "connecting" : waits ? "waiting" : "live";
	if (why) {
		state = "stale";
		if (ui.fleet) ui.staleSince ??= new Date(ui.fleet.time);
		label = ui.staleSince ? `stale since ${f.clock(ui.staleSince)}` : "no value yet";
	} else if (!waits) ui.staleSince = null;
	else if (ui.fleet) state = "stale"; // gray until a new overview arrives
	text($("status").lastElementChild, label);
	attribute($("status"), "data-state", state);
	attribute(document.body, "data-state", state);
	text($("why"), why);
	hide($("why"), !why);
	const known = ui.fleet?.packs, title = [state === "stale" && "stale", known && `${count(known.alive)} of ${count(known.known)} alive`, "Fleet"];
	if (changed(document.head, title.join())) document.title = title.filter(Boolean).join(" · ");
}

function tile(id, state) { attribute($(id), "class", `card ${state}`); }

function drawTiles({ packs, holders, unheld, twice, refused, lag_s, workers, states_per_s, concerns, attention_count, listening_s }) {
	const missing = packs.known - packs.alive, unsure = missing - packs.silent;
	put("alive", count(packs.alive));
	put("known", `of ${count(packs.known)}`);
	put("silent", packs.silent ? `${count(packs.silent)} silent for 3 min or more` : unsure ? `${count(unsure)} not heard yet, listening for ${duration(listening_s)}` : packs.known ? "none is silent" : "none was heard of yet");
	$("aliveshare").style.transform = `scaleX(${packs.known ? packs.alive / packs.known : 0})`;
	tile("alive", packs.silent > 0.01 * packs.known ? "wrong" : packs.silent ? "low" : unsure || !packs.known ? "" : "fine");

	const alive = workers.filter((w) => w.alive).length;
	put("held", count(holders.length - unheld.length));
	put("partitions", `of ${holders.length}`);
	put("unheld", refused.length ? `unreadable checkpoints: ${rangesText(refused)}` : unheld.length ? `unheld: ${rangesText(unheld)}` : twice.length ? `held twice: ${rangesText(twice)}` : `by ${counted(alive, "worker")}`);
	tile("held", unheld.length ? "wrong" : twice.length ? "low" : "fine");

	put("lag", seconds(lag_s));
	const samples = workers.map((w) => w.samples_per_s).filter(f.isNumber);
	put("rates", [`${rate(states_per_s) || 0} states/s`, samples.length && `${rate(samples.reduce((a, b) => a + b))} samples/s`].filter(Boolean).join(" · "));
	tile("lag", !f.isNumber(lag_s) ? "" : lag_s > MAX_LAG_S ? "wrong" : "fine");

	const present = KINDS.filter(([kind]) => concerns[kind]?.count).map(([kind, name]) => [concerns[kind].count, name]);
	put("attention", count(attention_count));
	put("attentionwhy", present.length ? present.sort((a, b) => b[0] - a[0]).map(([n, name]) => `${count(n)} ${name.toLowerCase().replace("soc", "SOC")}`).join(" · ") : "no pack does");
	tile("attention", concerns.margin?.count || concerns.suspects?.count ? "wrong" : present.length ? "low" : "fine");
}

/** Ascending numbers as ranges: "1–3, 7" for 1, 2, 3, 7. */
function rangesText(numbers) {
	const ranges = [];
	for (const n of numbers) {
		if (ranges.length && n === ranges.at(-1)[1] + 1) ranges.at(-1)[1] = n;
		else ranges.push([n, n]);
	}
	return ranges.map(([a, b]) => (a === b ? a : `${a}–${b}`)).join(", ");
}

// types and spreads

function drawTypes(types) {
	if (!changed($("types"), JSON.stringify([types, ui.type]))) return;
	const focused = document.activeElement?.dataset.type;
	$("types").replaceChildren(...types.map((t) => {
		const button = node("button", { type: "button", "data-type": t.type, "aria-pressed": String(t.type === ui.type) }, t.type);
		button.onclick = () => { ui.type = ui.type === t.type ? null : t.type; draw(); };
		return node("tr", t.type === ui.type ? { class: "chosen" } : {}, node("td", {}, button),
			...[count(t.packs), count(t.alive), percentText(t.soc_median), percentText(2 * t.soc_std_median, t.soc_std_median)].map((value) => node("td", {}, value)));
	}));
	if (focused) [...$("types").querySelectorAll("button")].find((b) => b.dataset.type === focused)?.focus();
}

const percentText = (x, known = x) => (f.isNumber(known) ? `${f.percent(x)} %` : "–");
function drawSpread(types, edges, uncertain) {
	const shown = types.find((t) => t.type === ui.type), some = shown ? [shown] : types, of = shown ? ` · ${shown.type}` : "";
	const sum = (name) => some.reduce((all, t) => all.map((n, i) => n + t[name][i]), some[0]?.[name].map(() => 0) ?? []);
	const soc = sum("soc"), std = sum("soc_std"), at = (i) => Math.round(200 * (edges[i] ?? 0.5)), range = (i) => (i < edges.length - 1 ? `${at(i)}–${at(i + 1)}` : `>${at(i)}`);
	bins($("soc"), soc, (i) => `${5 * i} to ${5 * i + 5} %`, (i) => (i < 2 ? "bad" : i < 4 ? "low" : ""), "State of charge");
	bins($("std"), std, (i) => `± ${range(i).replace("–", " to ")} %`, (i) => (at(i) >= 20 ? "bad" : at(i) >= 10 ? "low" : ""), "Uncertainty");
	if (changed($("stdedges"), "made")) $("stdedges").append(...std.map((_, i) => node("li", {}, range(i))));
	put("socmedian", soc.some(Boolean) ? `median ${f.fixed(median(soc, (i) => 5 * i), 0)} %${of}` : "");
	const unsure = uncertain ? ` · ${counted(uncertain, "pack")} above ± 10 %` : "";
	put("stdmedian", std.some(Boolean) ? `median ± ${f.fixed(median(std, at), 1)} %${of}${unsure}` : "");
}

/** Median of binned values, which are assumed to be evenly distributed within each bin. */
function median(counts, edge) {
	let rest = counts.reduce((a, b) => a + b, 0) / 2;
	const i = counts.findIndex((n) => (rest -= n) <= 0);
	return edge(i) + (1 + rest / counts[i]) * (edge(i + 1) - edge(i));
}

function bins(list, counts, name, kind, title) {
	const most = Math.max(...counts, 1);
	while (list.childElementCount < counts.length) list.append(node("li", {}, node("i", {})));
	counts.forEach((n, i) => {
		const item = list.children[i], height = n ? `${Math.max((100 * n) / most, 1.5).toFixed(1)}%` : "0";
		if (changed(item.firstChild, height)) item.firstChild.style.height = height;
		attribute(item, "class", kind(i));
		attribute(item, "title", `${name(i)}: ${counted(n, "pack")}`);
	});
	const top = counts.map((n, i) => [n, i]).filter(([n]) => n).sort((a, b) => b[0] - a[0]).slice(0, 3);
	attribute(list, "aria-label", `${title}: ${top.length ? top.map(([n, i]) => `${counted(n, "pack")} ${name(i)}`).join(", ") : "no pack"}`);
}

// packs that need attention

const KINDS = [
	["margin", "Small margin", (v) => `stability margin ${f.percent(v)} %`],
	["suspects", "Suspected", (v) => v],
	["soc", "Low SOC", (v) => `SOC ${f.percent(v)} %`],
	["silent", "Silent", (v) => (f.isNumber(v) ? `not heard for ${duration(v)}` : "never heard")],
	["clock", "Wrong clock", (v) => `its clock is ${duration(Math.abs(v))} ${v > 0 ? "ahead" : "behind"}`],
	["dead", "Dead letters", (v) => `blocks could not be processed: ${v}`],
	["unknown", "Unknown", (v) => `its blocks are held${v ? `: ${v}` : ""}`],
];
const NOTES = {
	all: "The worst packs of each kind.", margin: "Live packs, smallest margin first; counted below 5 %. Below 0 the thesis's model is not valid.",
	suspects: "Input faults that the identifier suspected in the last hour.", 
	soc: "Live packs, lowest SOC first; counted below 10 %.", silent: "No message for three minutes or more.", clock: "The clock of the pack's edge is wrong: its hourly summaries are quarantined.",
	dead: "Packs with blocks that no worker could process; fleet dead-letters lists these blocks.", unknown: "Packs that send blocks but are not in the table.",
};
const beyond = (c, v) => !("limit" in c) || v < c.limit;

/** Rows of [pack, [[kind, value], ...]]. The worst packs of each kind alternate; a pack has one row with all its reasons. */
function ranked(concerns) {
	const rows = new Map();
	for (let rank = 0; rank < MAX_LISTED; rank += 1) {
		for (const [kind] of KINDS) {
			const c = concerns[kind], [pack, value] = c?.packs[rank] ?? [];
			if (pack === undefined || !beyond(c, value)) continue;
			if (!rows.has(pack)) rows.set(pack, []);
			rows.get(pack).push([kind, value]);
		}
	}
	return [...rows].slice(0, MAX_LISTED);
}

function drawConcerns(concerns) {
	drawKinds(concerns);
	const rows = ui.kind === "all" ? ranked(concerns) : (concerns[ui.kind]?.packs ?? []).map(([pack, value]) => [pack, [[ui.kind, value]]]);
	text($("concernnote"), rows.length ? NOTES[ui.kind] : "No pack.");
	if (!changed($("concerns"), JSON.stringify([ui.kind, rows]))) return;
	const focused = document.activeElement?.dataset.pack;
	$("concerns").replaceChildren(...rows.map(([pack, reasons]) => {
		const mild = !reasons.some(([kind, value]) => beyond(concerns[kind], value));
		const texts = reasons.map(([kind, value]) => {
			const [, name, describe] = KINDS.find(([k]) => k === kind);
			return node("p", {}, node("span", { class: `tag ${mild ? "" : kind}` }, name), " ", describe(value));
		});
		return node("tr", mild ? { class: "mild" } : {}, node("th", { scope: "row" }, chooser(pack)), node("td", {}, ...texts));
	}));
	if (focused) [...$("concerns").querySelectorAll("button")].find((b) => b.dataset.pack === focused)?.focus();
}

function drawKinds(concerns) {
	const all = [["all", "All"], ...KINDS];
	if (changed($("kinds"), "made")) {
		$("kinds").append(...all.map(([kind, name]) => node("label", {}, node("input", { type: "radio", name: "kind", value: kind, ...(kind === ui.kind && { checked: "" }) }), node("span", {}, name, node("small", { "data-count": kind })))));
	}
	for (const [kind] of KINDS) text($("kinds").querySelector(`[data-count=${kind}]`), concerns[kind]?.count ? count(concerns[kind].count) : "");
}

function chooser(pack) {
	const button = node("button", { type: "button", "data-pack": pack }, pack);
	button.onclick = () => choose(pack);
	return button;
}

// workers

function drawWorkers({ workers, holders, unheld }) {
	const alive = workers.filter((w) => w.alive).length;
	put("workers", `${count(alive)} alive${workers.length > alive ? `, ${count(workers.length - alive)} gone` : ""}`);
	attribute($("holders"), "aria-label", `${holders.length} partitions: ${unheld.length ? `${rangesText(unheld)} not held` : "all held"}`);
	if (changed($("holders"), JSON.stringify([holders, workers.map((w) => w.id)]))) {
		$("holders").replaceChildren(...holders.map((index, n) => node("li", {
			class: index < 0 ? "unheld" : `c${index % COLORS}`, title: `partition ${n}: ${index < 0 ? "no worker" : workers[index].id}`,
		})));
	}
	if (!changed($("workers"), JSON.stringify(workers))) return;
	$("workers").replaceChildren(...workers.map((w, i) => {
		const values = w.alive ? [count(w.partitions), count(w.packs), seconds(w.lag_s), rate(w.samples_per_s) || "–"] : ["–", "–", `gone ${duration(w.heard_s)}`, "–"];
		const name = node("td", {}, node("i", { class: `swatch c${i % COLORS}` }), w.id, w.leaving ? " (leaving)" : "");
		for (const [format, partitions] of byFormat(w.refused)) {
			name.append(node("p", { class: "bad" }, `refuses ${partitions.length > 1 ? "partitions" : "partition"} ${rangesText(partitions)}: checkpoint format ${format || "unknown"}, reads ${[...new Set(w.checkpoint_formats)].join(", ")}`));
		}
		if (w.trouble) name.append(node("p", { class: "bad" }, w.trouble));
		return node("tr", w.alive ? {} : { class: "gone" }, name, ...values.map((value) => node("td", {}, value)));
	}));
}

/** Partitions by the format of their checkpoints. */
function byFormat(refused) {
	const formats = new Map();
	for (const [partition, format] of refused) formats.set(format, [...(formats.get(format) ?? []), partition]);
	return formats;
}

// query results

const percents = (x) => (f.isNumber(x) ? `${f.percent(x)} %` : "");
const between = (low, high, format) => (f.isNumber(low) && f.isNumber(high) ? `${format(low)} to ${format(high)}` : "");
// by query: title, note, text without rows, and columns as [heading, cell of a row]
const QUESTIONS = {
	failing: ["About to fail", "Packs with a faulty cell, that reach a limit within 90 days, or with recently suspected input faults.", "No pack.", [
		["Pack", (r) => chooser(r.pack)], ["What", (r) => `${r.quantity.replaceAll("_", " ")}${f.isNumber(r.cell) ? ` of cell ${r.cell}` : ""}`], ["Value", (r) => f.digits(r.value, 3)], ["Limit", (r) => f.digits(r.limit, 3)],
		["Days left", (r) => (f.isNumber(r.days_left) ? f.fixed(r.days_left, 0) : "")]]],
	soh: ["Capacity trend", "Change a year by type, with its 95 % band.", "", [
		["Type", (r) => r.type], ["Packs", (r) => count(r.packs)], ["Capacity", (r) => percents(r.capacity_ratio)],
		["A year", (r) => `${f.fixed(r.percent_per_year, 1)} %`], ["Band", (r) => between(r.percent_per_year_low, r.percent_per_year_high, (x) => `${f.fixed(x, 1)} %`)]]],
	outliers: ["Outliers of their type", "Packs whose capacity or Rₛ deviates from those of their type.", "No pack.", [
		["Pack", (r) => chooser(r.pack)], ["What", (r) => r.quantity.replaceAll("_", " ")], ["Value", (r) => f.digits(r.value, 3)], ["Type's median", (r) => f.digits(r.median_of_type, 3)],
		["Deviations", (r) => f.fixed(r.score, 1)]]],
	honest: ["Is the band correct?", "Fraction of hours in which the SOC was within ± two standard deviations, judged by later estimates; 95 % is correct.", "No hour can be judged yet.", [
		["Of", (r) => [r.of, r.which].filter(Boolean).join(" ")], ["Packs", (r) => count(r.packs)], ["Within", (r) => percents(r.within_2_std)], ["95 % interval", (r) => between(r.low, r.high, percents)],
		["Std should be", (r) => (f.isNumber(r.std_should_be_times) ? `× ${f.fixed(r.std_should_be_times, 2)}` : "")]]],
};

function drawAnswers(answers) {
	hide($("timecard"), !answers);
	hide($("failingcard"), !answers);
	if (!answers || !changed($("answers"), JSON.stringify(answers))) return;
	const tables = Object.entries(QUESTIONS).filter(([name]) => answers[name]).map(([name, question]) => answerTable(name, question, answers[name]));
	$("failing").replaceChildren(...tables.filter((t) => t.dataset.answer === "failing"));
	$("answers").replaceChildren(...tables.filter((t) => t.dataset.answer !== "failing"));
}

function answerTable(name, [title, note, noRows, columns], { reason, columns: names = [], rows = [], count: all, notes = [] }) {
	const records = rows.map((row) => Object.fromEntries(row.map((value, i) => [names[i], value])));
	const table = node("table", {}, node("thead", {}, node("tr", {}, ...columns.map(([head]) => node("th", { scope: "col" }, head)))),
		node("tbody", {}, ...records.map((r) => node("tr", {}, ...columns.map(([, cell]) => node("td", {}, cell(r) ?? ""))))));
	const message = reason ?? [rows.length ? note + (all > rows.length ? ` The first ${rows.length} of ${count(all)}.` : "") : noRows, ...notes].filter(Boolean).join(" ");
	return node("div", { "data-answer": name }, node("h3", {}, title), node("p", { class: "note" }, message), ...(rows.length ? [node("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": title }, table)] : []));
}

// details of one pack

const STATE = [
	["State of charge", (s) => percentText(s.soc)], ["±, two standard deviations", (s) => percentText(2 * s.soc_std, s.soc_std)], ["Stability margin", (s) => percentText(s.stability_margin)],
	["Voltage", (s) => f.volts(s.voltage_v)], ["estimated", (s) => f.volts(s.voltage_estimate_v)], ["Current", (s) => f.amperes(s.current_a)], ["Power", (s) => f.watts(s.power_w)],
	["Temperature", (s) => f.celsius(s.temperature_c)], ["Charge left to 0 %", (s) => f.ampereHours(s.remaining_capacity_ah)], ["Energy left to cut-off", (s) => f.wattHours(s.remaining_energy_wh)],
	["Innovation", (s) => f.millivolts(s.innovation_v)],
	["Energy out", (s) => (f.isNumber(s.energy_out_kwh) ? f.wattHours(1e3 * s.energy_out_kwh) : "")], ["Energy in", (s) => (f.isNumber(s.energy_in_kwh) ? f.wattHours(1e3 * s.energy_in_kwh) : "")],
	["Cycles", (s) => f.digits(s.equivalent_cycles, 3)], ["Measured", (s) => (s.time ? f.when(new Date(s.time)) : "")],
];

async function choose(name) {
	ui.pack = name;
	history.replaceState(null, "", `#${encodeURIComponent(name)}`);
	text($("packname"), name);
	for (const id of ["packwhat", "packsuspects"]) text($(id), "");
	drawFacts({});
	drawParameters(null, false);
	if (!$("one").open) $("one").showModal();
	await refresh();
}

async function refresh() {
	const name = ui.pack;
	let details = null, reason = "The page's server does not answer.";
	try {
		const answer = await fetch(`/pack?name=${encodeURIComponent(name)}`);
		if (answer.ok) details = await answer.json();
		else if (answer.status === 404) reason = "Nothing was heard of this pack yet, and it is not in the table.";
	} catch { /* the reason above is displayed */ }
	if (ui.pack !== name) return;
	text($("packwhat"), details ? [details.type, f.isNumber(details.heard_s) ? `last message ${duration(details.heard_s)} ago` : "no message since the start of this page"].join(" · ") : reason);
	text($("packsuspects"), details?.suspects ?? "");
	if (!details) return;
	drawFacts(details.state ?? {});
	drawParameters(details.parameters, !!details.state);
}

function drawFacts(state) {
	const facts = STATE.map(([name, format]) => [name, format(state)]).filter(([, value]) => value && value !== "–");
	$("packstate").replaceChildren(...facts.map(([name, value]) => node("div", {}, node("dt", {}, name), node("dd", {}, value))));
}

const NAMES = {
	r_s_ohm: ["Rₛ", 1e3, "mΩ"], r_ts_ohm: ["Rₜₛ", 1e3, "mΩ"], c_ts_farad: ["Cₜₛ", 1, "F"], r_tl_ohm: ["Rₜₗ", 1e3, "mΩ"], c_tl_farad: ["Cₜₗ", 1, "F"], e_o_v: ["E₀", 1, "V"],
	capacity: ["Capacity, of new", 100, "%"], r_s: ["Rₛ, of new", 100, "%"], current_offset_a: ["Current offset", 1e3, "mA"],
};

function drawParameters(report, known = true) {
	hide($("packparameters"), !report);
	hide($("noparameters"), !!report || !known);
	if (!report) return;
	const all = [...Object.entries(report.state_of_health ?? {}), ...Object.entries(report.elements ?? {})];
	$("parameters").replaceChildren(...all.map(([key, p]) => {
		const [name, factor, unit] = NAMES[key] ?? [key, 1, ""], [value, std] = f.withError(p.value, p.std, factor);
		return node("tr", {}, node("th", { scope: "row" }, name), node("td", {}, `${value} ${unit}`), node("td", {}, std), node("td", p.valid ? { class: "good" } : { title: p.reason ?? "" }, p.valid ? "✓ yes" : "no"));
	}));
}

$("one").onclose = () => {
	ui.pack = null;
	history.replaceState(null, "", location.pathname);
};
$("one").onclick = (event) => { if (event.target === $("one")) $("one").close(); }; // a click beside the dialog

// search for a pack, and choices of the user

let requestCount = 0;
async function find() {
	const prefix = $("prefix").value.trim(), request = (requestCount += 1);
	if (!prefix) return hide($("found"), true);
	let names = null;
	try {
		const answer = await fetch(`/packs?prefix=${encodeURIComponent(prefix)}`);
		names = answer.ok ? await answer.json() : null;
	} catch { /* a message is displayed below */ }
	if (request !== requestCount) return; // the user has typed more meanwhile
	if (changed($("found"), JSON.stringify(names))) { // an unchanged list keeps the focus of the user
		const rows = names?.map((name) => node("li", {}, chooser(name))) ?? [];
		$("found").replaceChildren(...(rows.length ? rows : [node("li", {}, node("p", {}, names ? "No pack has this prefix." : "The page's server does not answer."))]));
	}
	hide($("found"), false);
}

$("prefix").oninput = find;
$("find").onsubmit = (event) => {
	event.preventDefault();
	$("found").querySelector("button")?.click();
};
$("find").onkeydown = (event) => {
	const targets = [$("prefix"), ...$("found").querySelectorAll("button")], focused = targets.indexOf(document.activeElement);
	const next = { ArrowDown: focused + 1, ArrowUp: focused - 1 }[event.key];
	if (event.key === "Escape") hide($("found"), true);
	if (next === undefined || !targets[next]) return;
	event.preventDefault();
	targets[next].focus();
};
document.addEventListener("click", (event) => { if (!$("find").contains(event.target)) hide($("found"), true); });
$("found").addEventListener("click", () => hide($("found"), true));
$("kinds").onchange = (event) => { ui.kind = event.target.value; draw(); };
setInterval(() => { if (ui.pack !== null) refresh(); }, REFRESH_MS);

const stream = listen(receive, () => draw());
draw();
const linkedPack = decodeURIComponent(location.hash.slice(1));
if (linkedPack) choose(linkedPack);
