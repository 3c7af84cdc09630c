-- Packs of which nothing has arrived recently, or ever, by the server's clock: the clock of an edge may be wrong. If the table of
-- packs is stored, packs that were removed from it are left out. Needs: packs, days, stored, quarantined, listed.
WITH arrivals AS (
    SELECT pack, max(CASE WHEN received_hour <= $present_hour + 1 THEN received_hour ELSE hour + 1 END) AS last_arrival
    FROM (SELECT pack, hour, received_hour FROM stored UNION ALL SELECT pack, hour, received_hour FROM quarantined)
    WHERE received_hour <= $present_hour + 1 OR hour <= $present_hour
    GROUP BY pack
),
known AS (
    SELECT pack, last_arrival FROM arrivals
    WHERE (SELECT count(*) FROM listed) = 0 OR pack IN (SELECT pack FROM listed)
    UNION ALL
    SELECT pack, NULL FROM listed
    WHERE listed_hour < $present_hour - $silent_hours AND pack NOT IN (SELECT pack FROM arrivals)
)
SELECT
    type, k.pack, to_timestamp(last_arrival::BIGINT * 3600)::TIMESTAMP AS silent_since, $present_hour - last_arrival AS hours_silent,
    d.soc, d.soc_std, d.temperature_c
FROM known k LEFT JOIN packs p USING (pack) LEFT JOIN days d ON d.pack = p.pack AND d.last_hour = p.last_hour
WHERE last_arrival IS NULL OR $present_hour - last_arrival > $silent_hours
ORDER BY last_arrival DESC NULLS FIRST, k.pack
