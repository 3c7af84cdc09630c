// Health of the source and the service, and the last events.
import { $, changed, hide, node, text } from "./dom.js";
import * as f from "./format.js";

const MAX_FRACTION = 0.8; // of the present bound of the std: a change that lowers it less is not worth a line
const rows = {};

export function drawHealth({ topics: { health: h, info, state } }) {
	if (!h) return;
	const faults = h.suspects ?? []; // a silent sensor is stated above
	if (changed($("suspects"), faults.join("\n"))) $("suspects").replaceChildren(...faults.map((w) => node("li", { class: "alarm" }, node("b", {}, "Suspected"), node("span", {}, w))));
	const of = (x, unit) => f.isNumber(x) && `${f.digits(x, 3)} ${unit}`;
	const e = f.millivolts(state?.tracking_error_v);
	const tracking = e && `${state.lock ? "in" : "no"} lock, ${state.converged ? "converged" : "converging"}, e ${e}`;
	const facts = {
		Sensor: h.sensor_online ? "online" : "offline", "Sample rate": of(state?.sample_rate_hz, "Hz"), Frames: h.line?.frames_received,
		"Frames lost": h.line?.frames_lost, "Wrong checksums": h.line?.crc_errors, "Line connected again": h.reconnects,
		"Latency, median": of(1e3 * h.loop?.latency_p50_s || null, "ms"), "Board's clock": of(h.clock_ppm, "ppm"), Broker: h.broker_trouble,
		"Waiting for it": h.publish_waiting, Disk: h.store_trouble, Checkpoint: h.checkpoint, "Running for": f.duration(h.uptime_s),
		Crashes: h.total?.crashes, Observer: tracking, "Observer, N(k)": f.digits(state?.nussbaum_gain, 3), "Observer, limits": f.deltas(state ?? {}), Version: info?.version,
	};
	for (const [name, value] of Object.entries(facts)) {
		const row = (rows[name] ??= $("facts").appendChild(node("div", {}, node("dt", {}, name), node("dd", {}))));
		hide(row, !value && value !== 0);
		text(row.lastChild, f.isNumber(value) ? value.toLocaleString("en") : value || "");
	}
}

/** The change of use or sensors that lowers the bound of the std most. */
export function drawWhatHelps({ std, change, changed_std: changed } = {}) {
	const band = (x) => `± ${f.percent(2 * x, 0)} %`;
	const helps = change && changed <= MAX_FRACTION * std && band(changed) !== band(std);
	hide($("whathelps"), !helps);
	text($("whathelps"), helps ? `What would help: ${change}. The SOC could then be known to ${band(changed)}, instead of ${band(std)} at best in the present use.` : "");
}

export function drawEvents(pack) {
	hide($("eventcard"), !pack.events.length);
	if (!changed($("events"), `${pack.name} ${pack.events.length} ${pack.events[0]?.time}`)) return;
	$("events").replaceChildren(...pack.events.map((e) => node("li", {},
		node("time", { datetime: e.time }, f.when(new Date(e.time))), node("b", {}, f.words(e.name)), node("span", {}, e.text))));
}
