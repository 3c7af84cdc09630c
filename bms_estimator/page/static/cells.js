// Cells in series: their voltages, and their comparison.
import { $, attribute, changed, hide, node, put, text } from "./dom.js";
import * as f from "./format.js";

/** Draw the bars. The weakest cell is highlighted: that with the lowest SOC in the report, without a report that with the lowest voltage. */
export function drawCells(s, report) {
	const cells = Array.isArray(s.cells_v) ? s.cells_v : [], known = cells.filter(f.isNumber), count = known.length;
	hide($("cellcard"), !count);
	if (!count) return;
	const low = Math.min(...known), high = Math.max(...known);
	const first = cells.indexOf(low), last = cells.indexOf(high), weakest = weakestOf(report);
	const reach = Math.max(high - low, 0.04), floor = Math.max(low - reach, 0), roof = high + 0.25 * reach, bars = $("cells");
	while (bars.childElementCount > cells.length) bars.lastChild.remove();
	while (bars.childElementCount < cells.length) {
		bars.append(node("li", { role: "img" }, node("b", {}), node("div", { class: "cellbar" }, node("i", {})), node("span", {}, String(bars.childElementCount + 1))));
	}
	attribute(bars, "class", count > 16 ? "many" : "");
	cells.forEach((v, i) => {
		const item = bars.children[i], [value, box] = item.children, measured = f.isNumber(v);
		const rank = weakest ? i + 1 === weakest.number && "weakest" : low !== high && i === first && "lowest";
		text(value, f.fixed(v, 3));
		const scale = measured ? ((v - floor) / (roof - floor)).toFixed(3) : "0";
		if (changed(item, scale)) box.firstChild.style.transform = `scaleY(${scale})`;
		attribute(item, "class", rank ? "weakest" : low !== high && i === last ? "highest" : "");
		attribute(item, "aria-label", `cell ${i + 1}: ${measured ? `${v.toFixed(3)} V` : "not measured"}${rank ? `, ${rank}` : ""}`);
	});
	put("cellspread", `${count} measured`);
	put("celllow", `${low.toFixed(3)} V · cell ${first + 1}`);
	put("cellhigh", `${high.toFixed(3)} V · cell ${last + 1}`);
	put("cellapart", f.millivolts(high - low));
}

/** Cell with the lowest SOC in a report; undefined without a report. */
const weakestOf = (report) => report?.cells?.find((cell) => cell.number === report.weakest);

/** Name the cell with the lowest SOC, which the state has, its capacity once that of the pack is learned, and faulty cells. */
export function drawRanks(report, capacity) {
	const weakest = weakestOf(report);
	hide(document.querySelector("[data-of=weakestcell]"), !weakest);
	if (!weakest) return;
	const faults = report.cells.filter((c) => c.fault).map((c) => `cell ${c.number}: ${c.fault}`);
	put("weakestcell", [`cell ${weakest.number}${capacity?.valid ? `, capacity ${f.percent(weakest.capacity_ratio, 0)} % of the others` : ""}`, ...faults].join("; "));
}
