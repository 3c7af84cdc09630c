// Packs and their values, as received from the server.
import { Ring } from "./charts.js";
import { $, text } from "./dom.js";

const AHEAD_MS = 86_400_000; // a state further in the future has a wrong time
const ROWS = 3600; // of recent states
const COLUMNS = ["voltage_v", "voltage_estimate_v", "current_a", "soc", "soc_std", "innovation_v"];
const MAX_EVENTS = 50; // as many as the server stores

export const packs = new Map();
/** Event stream of the server, connection of the server to a broker (null: none), and time at which the broker came back. */
export const connection = { stream: null, broker: null, brokerMs: 0 };

class Pack {
	topics = {};
	recent = new Ring(1 + COLUMNS.length, ROWS);
	learned = {}; // element -> percent of SOC -> [value, std]
	events = [];
	history = {}; // span -> { at, data } or { at, reason }
	stateMs = 0; // arrival of the last state
	since = null; // time of the last state when it became stale
	constructor(name) { this.name = name; }
	store(topic, value) {
		if (topic === "recent") {
			this.recent.clear();
			(value.time_s ?? []).forEach((time, i) => this.recent.push([time, ...COLUMNS.map((c) => value[c]?.[i])]));
			return;
		}
		if (topic === "elements") { this.learned = value; return; }
		if (topic === "event") for (const event of value ?? []) this.addEvent(event);
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
		if (!connection.stream.open) return "the page's server does not answer";
		if (connection.broker && !connection.broker.up) return connection.broker.reason;
		if ((availability ?? "online") !== "online") return "the service is offline";
		if ((sensor ?? "online") !== "online") return health?.sensor_message || "the sensor is offline";
		return state && this.stateMs < connection.brokerMs ? "no value since the broker was lost" : "";
	}
}

/** Store a message of the event stream: values by `pack/topic`. */
export function receive(message) {
	for (const [key, value] of Object.entries(message)) {
		const slash = key.indexOf("/"), name = key.slice(0, slash);
		if (key === "link") {
			if (value.up && connection.broker?.up === false && packs.size) connection.brokerMs = Date.now();
			connection.broker = value;
		} else if (key === "packs") {
			for (const gone of packs.keys()) if (!value.names.includes(gone)) packs.delete(gone);
			text($("hidden"), value.hidden ? `${value.hidden} more devices not shown` : "");
		} else {
			if (!packs.has(name)) packs.set(name, new Pack(name));
			packs.get(name).store(key.slice(slash + 1), value);
		}
	}
}
