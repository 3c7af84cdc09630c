// The forecast: curves and values.
import { Curve, nulls, scaled } from "./charts.js";
import { $, hide, put, text } from "./dom.js";
import * as f from "./format.js";

export const charts = {};

/** Curves of the forecast: SOC and voltage with their 90 % bands, and the probability that the load is still on. */
export function drawForecast({ topics: { forecast: report, state } }) {
	const known = f.isNumber(state?.time_to_cutoff_s) && state.soc_known !== false, hasCurves = known && !!report?.elapsed_s?.length;
	hide($("forecastcard"), state?.soc_known === false || (!known && (!state?.forecast_reason || f.isNumber(state.time_to_full_s))));
	text($("noforecast"), !known ? `No time to the cut-off: ${state?.forecast_reason}.` : hasCurves ? "" : "The curves follow within a minute.");
	hide($("noforecast"), hasCurves);
	hide($("forecast"), !hasCurves);
	put("forecast_note", hasCurves ? `of ${f.clock(new Date(report.time))}, under a load like the one seen; shaded: 90 %` : "");
	if (!hasCurves) return;
	if (!charts.v) {
		const make = (title, unit, color, minSpan, more) => new Curve($("forecast"), title, unit, color, minSpan, { sync: "forecast", ...more });
		Object.assign(charts, {
			v: make("Voltage", "V", "--volt", 0.02, { first: "median", second: { color: "--bad", label: "cut-off", dash: [5, 3] } }),
			soc: make("State of charge", "%", "--soc", 2, { low: 0, high: 100 }),
			on: make("Load still on, probability", "%", "--amp", 200, { low: 0, high: 100 }),
		});
	}
	const start = Date.parse(report.time) / 1e3, time = report.elapsed_s.map((s) => start + s), no = nulls(time);
	const fan = (name, unit, factor) => ["p95", "p05", "p50"].map((q) => scaled(report[`${name}_${q}${unit}`] ?? [], factor));
	const columns = { v: [...fan("voltage", "_v", 1), time.map(() => report.cutoff_v)], soc: fan("soc", "", 100), on: [no, no, scaled(report.survival ?? [], 100)] };
	for (const [name, chart] of Object.entries(charts)) chart.draw([time, ...columns[name]], time[0], time.at(-1));
}

export function drawForecastValues(s, info) {
	const both = (name) => ["10s", "60s"].map((time) => f.watts(s[`${name}_${time}_w`]) || "–").join(", ");
	put("cutoff_within", [2, 5, 15].map((minutes) => `${f.percent(s[`cutoff_within_${minutes}min`], 0)} %`).join(", "));
	for (const way of ["discharge", "charge"]) {
		put(`${way}_power`, both(`available_${way}_power`));
		put(`${way}_limit`, info?.[`max_${way}_a`] === null ? "current limit assumed" : "");
	}
}
