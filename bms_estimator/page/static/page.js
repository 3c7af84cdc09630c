// The live page, drawn at most four times a second, its curves twice.
import { drawCells, drawRanks } from "./cells.js";
import { curves, drawCurves } from "./curves.js";
import { $, attribute, changed, hide, node, text } from "./dom.js";
import { describeElement, drawElement, redrawElement } from "./elements.js";
import { charts, drawForecast, drawForecastValues } from "./forecast.js";
import * as f from "./format.js";
import { drawEvents, drawHealth, drawWhatHelps } from "./health.js";
import { listen } from "./live.js";
import { connection, packs, receive } from "./packs.js";
import { drawParameters } from "./parameters.js";
import { drawState } from "./state.js";
import { showWhatIf } from "./what_if.js";

const DRAW_MS = 250, CURVES_MS = 500, DESCRIBE_MS = 10_000;
const ui = { pack: null, span: "live", drawn: 0, curves: -Infinity, described: -Infinity, due: false };

function drawSoon() {
	if (ui.due) return;
	ui.due = true;
	setTimeout(() => requestAnimationFrame(draw), Math.max(0, ui.drawn + DRAW_MS - performance.now()));
}

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
	showWhatIf(connection.broker || !f.isNumber(state.soc) || state.soc_known === false ? null : pack.name); // a dashboard, which has a link to a broker, makes no forecasts
	drawAlarms(pack);
	const capacity = pack.topics.parameters?.state_of_health?.capacity;
	drawState(state, capacity);
	drawForecastValues(state, pack.topics.info);
	drawCells(state, pack.topics.cells);
	drawRanks(pack.topics.cells, capacity);
	drawParameters(pack.topics.parameters);
	drawHealth(pack);
	drawWhatHelps(pack.topics.health?.pack_model?.soc_bound ?? {});
	drawEvents(pack);
	if (now - ui.curves >= CURVES_MS) {
		ui.curves = now;
		drawCurves(pack, ui.span, redrawAll);
		drawForecast(pack);
		drawElement(pack);
	}
	if (now - ui.described >= DESCRIBE_MS) {
		ui.described = now;
		describe(pack);
	}
}

function drawStatus(pack) {
	const { state } = pack?.topics ?? {}, trouble = pack ? pack.trouble : connection.broker?.reason ?? "";
	let kind = "wait", label = pack ? "waiting for a sample" : connection.stream.open ? "waiting for a pack" : "connecting";
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
	const title = [kind === "stale" && "stale", f.isNumber(state?.soc) && state.soc_known !== false && `${f.percent(state.soc, 0)} %`, pack?.name].filter(Boolean).join(" · ");
	if (document.title !== title) document.title = title || "bms_estimator";
}

function drawHead(pack) {
	const { info, state } = pack.topics;
	text($("name"), pack.name);
	const facts = info ? [info.cell, `${info.series_count} in series`, `nominal ${+info.nominal_voltage_v.toPrecision(4)} V`, f.ampereHours(info.capacity_ah)] : [];
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

/** Draw raised alarms, and those that cannot be watched: one row for each reason, none for a reason that a raised alarm states. */
function drawAlarms({ alarms, topics }) {
	const rows = alarms.filter((a) => a.active).map((a) => ({ ...a, names: [a.name] })), raised = rows.map((a) => a.text);
	for (const a of alarms.filter((b) => !b.active && b.watched === false && topics.health?.sensor_online !== false)) {
		if (raised.some((why) => why.includes(a.unwatched_reason))) continue;
		const same = rows.find((row) => !row.active && row.severity === a.severity && row.unwatched_reason === a.unwatched_reason);
		if (same) same.names.push(a.name);
		else rows.push({ ...a, names: [a.name] });
	}
	rows.sort((a, b) => (a.severity < b.severity ? -1 : 1));
	if (changed($("alarms"), JSON.stringify(rows))) $("alarms").replaceChildren(...rows.map(alarmRow));
}

function alarmRow(a) {
	const facts = [a.severity, a.since && `since ${f.when(new Date(a.since))}`, a.latched && "latched", a.watched === false && "cannot be watched", a.unknown_reason];
	return node("div", { class: `alarm ${a.severity}`, "data-alarm": a.names.join(" ") },
		node("b", {}, f.words(a.names.join(", "))), node("span", {}, a.text || a.unwatched_reason), node("small", {}, facts.filter(Boolean).join(" · ")));
}

function describe(pack) {
	for (const chart of Object.values(charts)) chart.describe("forecast");
	for (const chart of Object.values(curves)) chart.describe(ui.span === "live" ? "last five minutes" : `last ${ui.span}`);
	describeElement(pack);
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

$("expert").ontoggle = redrawAll;
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
$("element").onchange = redrawAll;
onresize = redrawAll;
matchMedia("(prefers-color-scheme: dark)").onchange = () => {
	for (const chart of [...Object.values(curves), ...Object.values(charts)]) chart.plot.redraw(false, true);
	redrawElement();
};
setInterval(drawSoon, 1000);
connection.stream = listen(receive, drawSoon);
