// The event stream of a page's server.
const SILENT_MS = 16_000; // an event arrives each 5 s

/** Receive /events for ever. `onState` is called when `stream.open` may have changed. */
export function listen(onMessage, onState, stream = { open: false }) {
	const source = new EventSource("events");
	let last = Date.now();
	const setOpen = (open) => { stream.open = open; onState(); };
	source.onmessage = (event) => {
		last = Date.now();
		onMessage(JSON.parse(event.data));
		setOpen(true);
	};
	source.onerror = () => setOpen(false);
	const watch = setInterval(() => { // refused, or nothing arrives any more
		if (source.readyState !== EventSource.CLOSED && Date.now() - last < SILENT_MS) return;
		clearInterval(watch);
		source.close();
		setOpen(false);
		listen(onMessage, onState, stream);
	}, 1000);
	return stream;
}
