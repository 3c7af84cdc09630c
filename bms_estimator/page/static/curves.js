// Curves of the measured values: the last minutes, and the history.
import { Curve, clip, nullGaps, nulls, scaled } from "./charts.js";
import { $, hide, text } from "./dom.js";

const SPANS = { live: 300, hour: 3600, day: 86400, month: 30 * 86400 }; // [s]
const LIVE_STEP_S = 4; // shortest step of the live curves [s]: gaps below 10 s are not drawn
const HISTORY_MS = 60_000; // shortest time between two requests for a history
export const curves = {};

function makeCurves() {
	const make = (...curve) => new Curve($("curves"), ...curve);
	Object.assign(curves, {
		soc: make("State of charge", "%", "--soc", 2, { low: 0, high: 100 }),
		v: make("Voltage", "V", "--volt", 0.02, { second: { color: "--estimate", label: "estimated", dash: [5, 3] } }),
		i: make("Current", "A", "--amp", 0.02),
		inno: new Curve($("innochart"), "Innovation", "mV", "--inno", 2),
		temp: make("Temperature", "°C", "--inno", 2),
	});
}

/** Draw the curves of a pack over a span. `onLoaded` is called when its history has arrived. */
export function drawCurves(pack, span, onLoaded) {
	if (!curves.soc) makeCurves();
	const live = span === "live";
	if (!live) loadHistory(pack, span, onLoaded);
	const past = pack.history[span];
	const reason = live ? "" : past?.reason ?? (past?.data?.time_s.length ? "" : past?.data ? "Nothing was recorded in this span." : "reading…");
	text($("nohistory"), reason);
	hide($("nohistory"), !reason);
	hide($("curves"), !!reason);
	if (reason) return;
	const columns = live ? liveColumns(pack) : (past.columns ??= pastColumns(past.data));
	const { time } = columns, end = live ? time.at(-1) ?? Date.now() / 1e3 : Date.now() / 1e3;
	const from = live ? Math.max(end - SPANS.live, Math.min(time[0] ?? end, end - 30)) : end - SPANS[span];
	// all are shown or hidden before the first is drawn, because this decides their widths
	for (const [name, chart] of Object.entries(curves)) hide(chart.box, !columns[name]?.[2].some((v) => v !== null));
	for (const [name, chart] of Object.entries(curves)) {
		const drawn = columns[name];
		if (drawn?.[3]) hide(chart.box.querySelector(".estimate"), !live);
		if (!chart.box.hidden) chart.draw([time, ...drawn], from, end);
	}
}

/** Upper edge, lower edge and value of the SOC [%]. */
function socColumns(soc, std) {
	const edge = (sign) => Array.from(soc, (v, i) => (Number.isFinite(v) && Number.isFinite(std[i]) ? 100 * clip(v + sign * 2 * std[i]) : null));
	return [edge(1), edge(-1), scaled(soc, 100)];
}

function liveColumns(pack) {
	const [times, ...values] = pack.recent.views(pack.recent.last - SPANS.live), step = Math.max((times.at(-1) - times[0]) / times.length, LIVE_STEP_S);
	const [time, pick] = withGaps(times, step), [v, estimate, i, soc, std, inno] = values.map(pick), no = nulls(time);
	return { time, v: [no, no, nullGaps(v), nullGaps(estimate)], i: [no, no, nullGaps(i)], soc: socColumns(soc, std), inno: [no, no, scaled(inno, 1e3)] };
}

/** Times with a gap after 2.5 steps [s] without a row, and the function that inserts the gaps into a column. */
function withGaps(time, step) {
	const at = [];
	time.forEach((t, i) => { if (i && t - time[i - 1] > 2.5 * step) at.push(-1); at.push(i); });
	return [at.map((i, n) => (i < 0 ? time[at[n - 1]] + step : time[i])), (column) => at.map((i) => column[i] ?? null)];
}

/** Columns of a history. */
function pastColumns(data) {
	const [time, insert] = withGaps(data.time_s, data.step_s), pick = (name) => insert(data[name]), no = nulls(time);
	const span = (name, unit) => [pick(`${name}_max_${unit}`), pick(`${name}_min_${unit}`), pick(`${name}_${unit}`)];
	return { time, v: [...span("voltage", "v"), no], i: span("current", "a"), soc: socColumns(pick("soc"), pick("soc_std")), temp: [no, no, pick("temperature_c")] };
}

async function loadHistory(pack, span, onLoaded) {
	const before = pack.history[span];
	if (before && Date.now() - before.at < HISTORY_MS) return;
	pack.history[span] = { ...before, at: Date.now() };
	let result = before?.data ? { data: before.data } : { reason: "The page's server does not answer." };
	try {
		const answer = await fetch(`history?pack=${encodeURIComponent(pack.name)}&span=${span}`);
		result = answer.ok ? { data: await answer.json() } : { reason: "No history is kept here: it lies where the pack's service runs." };
	} catch { /* the status shows it, too */ }
	for (const e of result.data?.events ?? []) pack.addEvent({ ...e, time: new Date(1e3 * e.time_s).toISOString() });
	pack.history[span] = { at: Date.now(), ...result };
	onLoaded();
}
