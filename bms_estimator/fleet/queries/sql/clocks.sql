-- Wrong clocks: of edges with quarantined hours, with their last error and the end of the last hour on their clock; of edges
-- that are constantly behind, whose hours are not quarantined; and of the server. Needs: quarantined, hours, server_errors.
WITH recent AS (
    SELECT pack, hour, received_hour, received_hour - hour - 1 AS behind FROM hours
    WHERE received_hour BETWEEN $now_hour - 23 AND $now_hour + 1
)
SELECT
    'edge' AS clock, pack, to_timestamp((arg_max(hour, revision)::BIGINT + 1) * 3600)::TIMESTAMP AS clock_time,
    arg_max(q.clock_error_s, revision) AS clock_error_s, count(*) AS quarantined_hours,
    to_timestamp(min(received_hour) * 3600)::TIMESTAMP AS first_received,
    to_timestamp(max(received_hour) * 3600)::TIMESTAMP AS last_received
FROM quarantined q
WHERE received_hour IS NULL OR received_hour NOT IN (SELECT received_hour FROM server_errors)
GROUP BY pack
UNION ALL
-- the delay of stored blocks shrinks while an edge sends them
SELECT
    'edge', pack, to_timestamp((max(hour)::BIGINT + 1) * 3600)::TIMESTAMP, -3600.0 * min(behind), 0,
    to_timestamp(min(received_hour) * 3600)::TIMESTAMP, to_timestamp(max(received_hour) * 3600)::TIMESTAMP
FROM recent
GROUP BY pack
HAVING count(DISTINCT received_hour) >= 3 AND min(behind) >= $behind_h AND max(behind) - min(behind) <= 1
UNION ALL
SELECT
    'server', NULL, to_timestamp(max(received_hour) * 3600)::TIMESTAMP, arg_max(error_s, received_hour), sum(rows)::BIGINT,
    to_timestamp(min(received_hour) * 3600)::TIMESTAMP, to_timestamp(max(received_hour) * 3600)::TIMESTAMP
FROM server_errors
HAVING count(*) > 0
ORDER BY clock DESC, last_received DESC, pack
