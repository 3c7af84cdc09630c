-- Packs whose edge's clock is wrong, with their last error. Needs: quarantined.
SELECT
    pack, arg_max(q.clock_error_s, revision) AS clock_error_s, count(*) AS quarantined_hours,
    to_timestamp(min(received_hour) * 3600)::TIMESTAMP AS first_received,
    to_timestamp(max(received_hour) * 3600)::TIMESTAMP AS last_received
FROM quarantined q
GROUP BY pack
ORDER BY last_received DESC, pack
