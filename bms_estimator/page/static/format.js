// Numbers and times as text. Pure. Unknown values are "", never NaN.

export const isNumber = Number.isFinite;
const withMinus = (text) => (Number(text) === 0 ? text.replace("-", "") : text).replace("-", "−");

/** Fixed decimals; a minus sign in place of a hyphen, none before a zero. */
export const fixed = (x, decimals) => (isNumber(x) ? withMinus(x.toFixed(decimals)) : "");

/** About four digits: three decimals below 10, two below 100, one above. */
export const plain = (x) => fixed(x, Math.abs(x) < 9.9995 ? 3 : Math.abs(x) < 99.995 ? 2 : 1);

/** A number with `count` digits, at most nine decimals, and no exponent: 1.234, 0.0123, 12340. */
export function digits(x, count = 4) {
	if (!isNumber(x)) return "";
	const decimals = x === 0 ? 0 : Math.min(Math.max(count - 1 - Math.floor(Math.log10(Math.abs(x))), 0), 9);
	return withMinus(String(x.toFixed(decimals)).replace(/(\.\d*?)0+$/, "$1").replace(/\.$/, ""));
}

/** A value and its standard deviation, which determines the decimals of both. */
export function withError(value, std, factor) {
	if (!isNumber(std)) return [digits(factor * value), ""];
	const error = factor * std, decimals = Math.min(Math.max(1 - Math.floor(Math.log10(error || 1)), 0), 8);
	return error < 1e-7 ? [digits(factor * value), digits(error, 2)] : [fixed(factor * value, decimals), digits(error, 2)];
}

const unit = (text, name) => (text === "" ? "" : `${text} ${name}`);
export const volts = (x) => unit(plain(x), "V");
export const amperes = (x) => unit(plain(x), "A");
export const watts = (x) => unit(fixed(x, Math.abs(x) < 9.995 ? 2 : Math.abs(x) < 99.95 ? 1 : 0), "W");
export const celsius = (x) => unit(fixed(x, 1), "°C");
export const millivolts = (x) => unit(isNumber(x) ? fixed(1e3 * x, Math.abs(x) < 0.1 ? 1 : 0) : "", "mV");
export const words = (name) => name.replaceAll("_", " ").replace("soc", "SOC");
export const percent = (x, decimals = 1) => (isNumber(x) ? fixed(100 * x, decimals) : "");
export const ampereHours = (x) => unit(plain(x), "Ah");
export const wattHours = (x) =>
	Math.abs(x) >= 9999.5 ? unit(plain(x / 1e3), "kWh") : unit(fixed(x, Math.abs(x) < 9.995 ? 2 : Math.abs(x) < 999.5 ? 1 : 0), "Wh");
/** δ₁ and δ₂ in percent of SOC. */
export const deltas = (s) => [s.delta_1, s.delta_2].map((d, i) => isNumber(d) && `δ${"₁₂"[i]} ${percent(d)} %`).filter(Boolean).join(", ");

/** Hours and minutes; only minutes below an hour, days from two days on. */
export function duration(seconds) {
	if (!isNumber(seconds)) return "";
	const minutes = Math.round(seconds / 60);
	if (seconds < 90) return `${Math.round(seconds)} s`;
	if (minutes < 60) return `${minutes} min`;
	if (minutes >= 2880) return `${(minutes / 1440).toFixed(1)} d`;
	return `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, "0")} min`;
}

/** Two durations as a range: 3–15 min, 1 h 20 min – 2 h 31 min. */
export function durations(from, to) {
	if (!isNumber(from) || !isNumber(to)) return "";
	return to < 3600 ? `${Math.round(from / 60)}–${Math.round(to / 60)} min` : `${duration(from)} – ${duration(to)}`;
}

const pad = (x) => String(x).padStart(2, "0");
export const hourMinute = (date) => `${pad(date.getHours())}:${pad(date.getMinutes())}`;
/** HH:MM:SS of this browser's clock. */
export const clock = (date) => `${hourMinute(date)}:${pad(date.getSeconds())}`;
export const dayMonth = (date) => `${date.getDate()} ${"Jan Feb Mar Apr May Jun Jul Aug Sep Oct Nov Dec".split(" ")[date.getMonth()]}`;
export const when = (date) => `${dayMonth(date)} ${clock(date)}`;
