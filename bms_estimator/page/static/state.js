// Values of the topic `state`, the time left, and the scale of the SOC.
import { clip } from "./charts.js";
import { $, attribute, hide, put } from "./dom.js";
import * as f from "./format.js";

const MIN_POINT_S = 600; // shortest time to the cut-off that is shown as one number [s]
const SHOWN = {
	voltage_v: f.volts, voltage_estimate_v: f.volts, current_a: f.amperes, power_w: f.watts, temperature_c: f.celsius,
	innovation_v: f.millivolts, device_soc: (x) => f.percent(x, 0), usable_capacity_ah: f.ampereHours, remaining_energy_wh: f.wattHours, remaining_capacity_ah: f.ampereHours,
	energy_out_kwh: (x) => f.wattHours(1e3 * x), energy_in_kwh: (x) => f.wattHours(1e3 * x), soc: f.percent, weakest_cell_soc: f.percent, stability_margin: f.percent,
};
const UNCERTAIN = ["soc_std", "time_to_cutoff_s", "time_to_full_s", "remaining_energy_wh", "remaining_capacity_ah", "usable_capacity_ah", "weakest_cell_soc"];
const parts = [...document.querySelectorAll("[data-of]")]; // shown only if there is a value

/** Time to the cut-off, or while charging to full, with its 90 % band. Below ten minutes a single load peak decides, so only the band is shown. */
function timeLeft(s) {
	const { time_to_cutoff_s: median, time_to_cutoff_p05_s: early, time_to_cutoff_p95_s: late } = s;
	if (!f.isNumber(median)) return ["To full", f.duration(s.time_to_full_s), ""];
	const band = f.durations(early, late);
	if (median >= MIN_POINT_S) return ["To cut-off", f.duration(median), `90 % band ${band}`];
	return ["To cut-off", band, `90 % band; ${f.percent(s.cutoff_within_5min, 0)} % within 5 min`];
}

/** Capacity of new, or that it is not known yet. */
function capacityHealth(capacity) {
	const band = `± ${f.percent(2 * capacity?.std, 0)} %`;
	if (capacity?.valid) return [`${f.percent(capacity.value, 0)} % of new`, band];
	return ["not known yet", capacity?.std < 0.05 ? `so far ${f.percent(capacity.value, 0)} ${band}` : "after two full charges"];
}

export function drawState(state, capacity) {
	const known = state.soc_known !== false, s = known ? { ...state } : { ...state, ...Object.fromEntries(UNCERTAIN.map((name) => [name, null])) };
	s.time_left = s.time_to_cutoff_s ?? s.time_to_full_s;
	if (!s.energy_out_kwh && !s.energy_in_kwh) s.energy_out_kwh = null; // nothing counted yet
	s.capacity_health = capacity ? 1 : null;
	const [label, left, band] = timeLeft(s), [health, note] = capacityHealth(capacity);
	for (const [name, show] of Object.entries(SHOWN)) put(name, show(s[name]));
	for (const part of parts) if (part.dataset.of !== "weakestcell") hide(part, !f.isNumber(s[part.dataset.of]));
	put("capacity_health", health);
	put("capacity_note", note);
	put("invalid_below", f.percent(Math.max(s.delta_1, s.delta_2)));
	put("soc_std", f.percent(f.isNumber(s.soc_std) ? 2 * s.soc_std : null));
	put("weakest_cell_soc_std", f.percent(f.isNumber(s.weakest_cell_soc_std) ? 2 * s.weakest_cell_soc_std : null));
	put("temperatures_c", s.temperatures_c?.map((c, i) => (f.fixed(c, 1) || "–") + (s.faulty_probes.includes(i + 1) ? " faulty" : "")).join(", ") ?? "");
	put("time_left", left);
	put("time_left_label", label);
	put("time_left_band", band);
	put("way", s.current_a > 0 ? "discharging" : s.current_a < 0 ? "charging" : "at rest");
	put("stability_margin_std", f.percent(2 * (s.stability_margin_std ?? NaN)));
	put("innovation_of", f.isNumber(state.soc_std) ? "measured − predicted" : "of the observer"); // without the identifier
	hide($("soc"), !known);
	hide($("unknownsoc"), known);
	hide($("scale"), !known);
	if (f.isNumber(s.soc) && known) drawScale(s);
}

function drawScale(s) {
	const band = 2 * (s.soc_std ?? 0);
	const place = (id, name, x) => {
		const value = `${(100 * clip(x)).toFixed(2)}%`, element = $(id);
		if (element[name] !== value) element.style[name] = element[name] = value;
	};
	place("fill", "width", s.soc - band);
	place("band", "left", s.soc - band);
	place("band", "width", clip(s.soc + band) - clip(s.soc - band));
	place("at", "left", s.soc);
	attribute($("fill"), "class", s.soc <= 0.1 ? "bad" : s.soc < 0.2 ? "low" : "");
	attribute($("scale"), "aria-valuenow", String(Math.round(100 * s.soc)));
	attribute($("scale"), "aria-valuetext", `${f.percent(s.soc, 0)} %, give or take ${f.percent(band, 0)} %`);
}
