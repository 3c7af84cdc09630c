// The form "What if": a forecast under a load that the user gives.
import { $, hide, node, text } from "./dom.js";
import * as f from "./format.js";

const MAX_BYTES = 131_072; // of a request
const LOADS = { power_w: "profile", current_a: "current_profile" }; // argument of a profile, by its column
const VERDICT_CLASS = { enough: "good", "not enough": "bad", uncertain: "low" };
let shown = null; // name of the pack

/** Show the form for a pack; null: there are no forecasts. The answer for another pack is removed. */
export function showWhatIf(name) {
	hide($("whatif"), name === null);
	if (name === shown) return;
	shown = name;
	$("whatif_answer").replaceChildren();
}

/** Points [time, load] of a CSV text, and their column. Points at which the load does not change are left out. */
export function readProfile(csv) {
	const rows = csv.split(/\r?\n/).filter((line) => line.trim() && !line.startsWith("#"));
	const separator = [";", "\t", ","].find((s) => rows[0]?.includes(s)) ?? ",";
	const cells = rows.map((line) => line.split(separator).map((cell) => cell.trim()));
	const header = cells.shift() ?? [], time = header.indexOf("time_s"), names = Object.keys(LOADS).filter((n) => header.includes(n));
	if (time < 0 || names.length !== 1) throw new Error("The file needs the columns time_s and either power_w or current_a.");
	const load = header.indexOf(names[0]);
	const points = cells.map((row, i) => [row[time], row[load]].map((cell) => {
		const value = cell === "" || cell === undefined ? NaN : Number(separator === "," ? cell : cell.replace(",", "."));
		if (!Number.isFinite(value)) throw new Error(`Row ${i + 1}: “${cell ?? ""}” is not a number.`);
		return value;
	}));
	const last = points.length - 1;
	return { column: names[0], points: points.filter(([, value], i) => i === 0 || i === last || value !== points[i - 1][1]) };
}

/** Arguments of the request. */
async function readForm() {
	const kind = $("whatif_kind").value;
	if (kind === "file") {
		const file = $("whatif_file").files[0];
		if (!file) throw new Error("Choose a file.");
		const { column, points } = readProfile(await file.text());
		return { [LOADS[column]]: points };
	}
	const minutes = $("whatif_minutes").valueAsNumber;
	return { [kind]: $("whatif_value").valueAsNumber, ...(minutes > 0 && { duration_s: 60 * minutes }) };
}

async function request(body) {
	const response = await fetch(`forecast?pack=${encodeURIComponent(shown)}`, { method: "POST", headers: { "Content-Type": "application/json" }, body });
	if (!response.ok) throw new Error(await response.text());
	const { data, error } = await response.json();
	if (error) throw new Error(error);
	return data;
}

/** Lines of the answer. */
function answer(data) {
	const line = (...parts) => node("p", {}, ...parts);
	const { time_to_cutoff_s: median, time_to_cutoff_p05_s: early, time_to_cutoff_p95_s: late, trip } = data;
	const band = `90 % band ${f.durations(early, late)}`;
	const lines = [data.reason ? line(`No time to the cut-off: ${data.reason}.`) : line(`Cut-off at ${f.volts(data.cutoff_v)}: `, median < 600 ? band : node("b", {}, `in ${f.duration(median)}`), median < 600 ? "" : `, ${band}`)];
	if (!trip) return lines;
	const percent = (x) => f.percent(x, 0);
	return [
		line("Charge for this load: ", node("b", { class: VERDICT_CLASS[trip.verdict] }, trip.verdict), `, probability ${percent(trip.enough_probability)} %`),
		...lines,
		line(`At its end: SOC ${percent(trip.soc_p50)} % (${percent(trip.soc_p05)}–${percent(trip.soc_p95)} %), ${f.volts(trip.voltage_p50_v)}. Energy needed: ${f.wattHours(trip.energy_wh)}.`),
	];
}

function drawKind() {
	const kind = $("whatif_kind").value, isFile = kind === "file";
	for (const label of document.querySelectorAll("#whatif label[data-for]")) hide(label, (label.dataset.for === "file") !== isFile);
	text($("whatif_unit"), kind === "power_w" ? "W" : "A");
	$("whatif_value").required = !isFile;
}

$("whatif_kind").onchange = drawKind;
$("whatif_form").onsubmit = async (event) => {
	event.preventDefault();
	const name = shown, button = event.target.querySelector("button");
	button.disabled = true;
	let lines;
	try {
		const body = JSON.stringify(await readForm());
		if (body.length > MAX_BYTES) throw new Error("The profile has too many points for the page; use `bms-estimator forecast --load`.");
		lines = answer(await request(body));
	} catch (error) {
		lines = [node("p", { class: "bad" }, error instanceof TypeError ? "The page's server does not answer." : error.message)];
	}
	button.disabled = false;
	if (name === shown) $("whatif_answer").replaceChildren(...lines);
};
drawKind();
