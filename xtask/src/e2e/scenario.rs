//! What is tried in the guest, in order: the sensor is found, configured, streams, gives depth that is
//! held against the truth, and survives each fault once.

use std::time::{Duration, Instant};

use serde_json::Value;

use super::bench::{Bench, TIMEOUT_S};
use super::{depth, formats};

/// A scenario's name, and what runs it: what was seen, or what was wrong.
pub type Scenario = (&'static str, fn(&mut Bench) -> Result<String, String>);

/// So many scenarios make the others possible, and always run.
pub const FIRST: usize = 2;

/// All scenarios.
pub const ALL: &[Scenario] = &[
    ("kernel sees three devices", nodes),
    ("timing set, read back", timing),
    ("protocol suite over USB", protocol_suite),
    ("list", list),
    ("doctor", doctor),
    ("camera controls", camera_controls),
    ("ten pairs", pairs),
    ("ten depth frames", depth::depth),
    ("live depth", depth::stream),
    ("device busy", busy),
    ("lost frame", |bench| frame_fault(bench, "left", "lost")),
    ("duplicated frame", |bench| frame_fault(bench, "right", "duplicated")),
    ("camera a frame late", |bench| frame_fault(bench, "left", "lagging")),
    ("short picture", |bench| frame_fault(bench, "right", "short")),
    ("corrupt picture", |bench| frame_fault(bench, "right", "corrupt")),
    ("lost trigger event", |bench| event_fault(bench, "lost")),
    ("corrupt trigger event", |bench| event_fault(bench, "corrupt")),
    ("halted endpoint", halt),
    ("camera unplugged, plugged", camera_unplugged),
    ("control unplugged, plugged", control_unplugged),
    ("device reset", reset),
    ("firmware hangs", hang),
    ("interlock opens", interlock),
    ("clock of the host steps", clock_step),
    ("doctor names what is wrong", doctor_names),
    ("depth after all faults", depth::again),
    ("pixel formats", formats::formats),
    ("cameras side by side", formats::side_by_side),
    // Pictures of 1280x1024 pass through some dozen wake-ups of an emulated processor each.
    ("pairs at full size", depth::full_pairs),
    ("depth at full size", depth::full_depth),
];

/// What the kernel makes of all devices.
fn nodes(bench: &mut Bench) -> Result<String, String> {
    let names = wait_for_nodes(bench, 4)?;
    let expected = ["stspp left camera", "stspp right camera"];
    match expected.iter().find(|e| !names.iter().any(|n| n.starts_with(*e))) {
        None => Ok("2 video and 2 metadata nodes by the stock uvcvideo".into()),
        Some(_) => Err(format!("the kernel made {names:?}")),
    }
}

/// Waits until the kernel has made `count` video and metadata nodes; their names.
///
/// # Errors
/// What it made.
pub fn wait_for_nodes(bench: &mut Bench, count: usize) -> Result<Vec<String>, String> {
    let deadline = Instant::now() + Duration::from_secs(20).mul_f64(bench.slowness);
    let mut names = Vec::new();
    while Instant::now() < deadline {
        names.clear();
        for number in 0..8 {
            let path = format!("/sys/class/video4linux/video{number}/name");
            let reply = bench.machine.request(&["read", &path])?;
            if reply.code == 0 {
                names.push(reply.text().trim().to_owned());
            }
        }
        if names.len() == count {
            return Ok(names);
        }
        std::thread::sleep(Duration::from_millis(200));
    }
    Err(format!("the kernel made {names:?}"))
}

fn protocol_suite(bench: &mut Bench) -> Result<String, String> {
    let arguments = ["--ignored", "--exact", "usb_of_this_machine"];
    let text = bench.run(60, "/bin/transports", &arguments)?;
    // The suite leaves a new device's timing behind.
    set_timing(bench)?;
    if text.contains("1 passed") {
        Ok("the tests of sim: and serial: hold over libusb".into())
    } else {
        Err(format!("the test did not run: {text}"))
    }
}

fn list(bench: &mut Bench) -> Result<String, String> {
    let json = bench.stspp_json(30, &["list", "--json"])?;
    let sensors = json["sensors"].as_array().cloned().unwrap_or_default();
    let usb: Vec<&Value> = sensors.iter().filter(|s| s["kind"] == "usb").collect();
    let [sensor] = usb.as_slice() else { return Err(format!("{json}")) };
    let field = |name: &str| sensor[name].as_str().unwrap_or_default().to_owned();
    let (serial, firmware, protocol) = (field("serial"), field("firmware"), field("protocol"));
    if serial.len() != 24 || firmware.is_empty() || protocol.is_empty() {
        return Err(format!("{sensor}"));
    }
    Ok(format!("{serial}, firmware {firmware}, protocol {protocol}"))
}

fn doctor(bench: &mut Bench) -> Result<String, String> {
    let source = bench.source();
    let json = bench.stspp_json(30, &["doctor", "--json", "--source", &source])?;
    let checks = json["checks"].as_array().cloned().unwrap_or_default();
    let poor = checks.iter().filter(|c| c["verdict"] == "poor").count();
    if json["bad"] != 0 || checks.len() < 10 {
        return Err(format!("{json}"));
    }
    Ok(format!("{} checks, none failed, {poor} could be better", checks.len()))
}

/// What is done to the sensor, what undoes it, and the check that must fail with these words.
const AILMENTS: [(&str, &str, &str, &str); 4] = [
    ("interlock open", "interlock closed", "state", "interlock"),
    ("unplug right", "plug right", "cameras", "right camera is gone"),
    ("unplug left", "plug left", "cameras", "left camera is gone"),
    ("unplug control", "plug control", "on the bus", "no sensor"),
];

fn doctor_names(bench: &mut Bench) -> Result<String, String> {
    for (harm, cure, check, words) in AILMENTS {
        bench.server.command(harm)?;
        let named = doctor_until(bench, |json| {
            let checks = json["checks"].as_array().into_iter().flatten();
            let mut bad = checks.filter(|c| c["verdict"] == "bad" && c["name"] == check);
            bad.any(|c| {
                let remedy = c["remedy"].as_str().unwrap_or_default();
                c["found"].as_str().is_some_and(|f| f.contains(words)) && !remedy.is_empty()
            })
        });
        bench.server.command(cure)?;
        if let Some(device) = cure.strip_prefix("plug ") {
            bench.plug_in(device)?;
        }
        named.map_err(|json| format!("{harm}: no word of {words:?} in {json}"))?;
        bench.stspp(20, &["doctor", "--clear-faults", "--quiet", "--source", "usb:"])?;
        doctor_until(bench, |json| json["bad"] == 0)
            .map_err(|json| format!("after {cure}: {json}"))?;
    }
    set_timing(bench)?;
    Ok("open interlock, either camera or the control interface unplugged: each named".into())
}

/// Asks `doctor` until it says what it should: the guest's kernel takes a moment to see a change.
fn doctor_until(bench: &mut Bench, says: impl Fn(&Value) -> bool) -> Result<(), String> {
    let source = bench.source();
    let deadline = Instant::now() + Duration::from_secs(15).mul_f64(bench.slowness);
    loop {
        let reply = bench.stspp(30, &["doctor", "--json", "--source", &source])?;
        let text = reply.text();
        // An error may follow it.
        let from = &text[text.find('{').unwrap_or(0)..];
        let json = serde_json::Deserializer::from_str(from).into_iter().next().and_then(Result::ok);
        if json.as_ref().is_some_and(&says) {
            return Ok(());
        }
        if Instant::now() > deadline {
            return Err(text);
        }
        std::thread::sleep(Duration::from_millis(300));
    }
}

/// The longest period there is: the guest's emulated processor moves few pictures a second.
const PERIOD_US: &str = "65000";

/// Sets the timing of all scenarios.
///
/// # Errors
/// What `stspp` said.
pub fn set_timing(bench: &mut Bench) -> Result<Value, String> {
    let set =
        ["timing", "set", "--json", "--source", "usb:", "--defaults", "--period-us", PERIOD_US];
    bench.stspp_json(30, &set)
}

fn timing(bench: &mut Bench) -> Result<String, String> {
    let set = set_timing(bench)?;
    let got = bench.stspp_json(30, &["timing", "get", "--json", "--source", "usb:"])?;
    let timing = |json: &Value| json.get("timing").unwrap_or(json).clone();
    if timing(&set) != timing(&got) || timing(&got)["frame_period_us"] != 65_000 {
        return Err(format!("set {set}, got {got}"));
    }
    let bad = bench.stspp(30, &["timing", "set", "--source", "usb:", "--exposure-us", "64999"])?;
    if bad.code == 0 {
        return Err("an impossible timing was accepted".into());
    }
    Ok(format!("a period of {PERIOD_US} us; an impossible one refused"))
}

fn camera_controls(bench: &mut Bench) -> Result<String, String> {
    let bright = |bench: &mut Bench, options: &str| -> Result<f64, String> {
        let source = format!("{}&{options}", bench.source());
        let words =
            ["stream", "--pairs", "--json", "--timeout", TIMEOUT_S, "--source", &source, "-n", "4"];
        let text = bench.stspp_ok(60, &words)?;
        let pair = text.lines().rfind(|line| line.contains("mean_grey")).unwrap_or_default();
        let json: Value = serde_json::from_str(pair).map_err(|e| format!("{e}: {text}"))?;
        json["mean_grey"][0].as_f64().ok_or_else(|| format!("no grey value: {json}"))
    };
    let short = bright(bench, "exposure_us=4000&gain=100")?;
    let gained = bright(bench, "exposure_us=4000&gain=400")?;
    // Last, because the cameras keep what they are set to.
    let full = bright(bench, "exposure_us=100000&gain=100")?;
    // The default exposure is 32 ms: an eighth of the light, then four times its numbers.
    let told =
        format!("mean grey {full:.1}, {short:.1} at 1/8 of the exposure, {gained:.1} at gain 4");
    if short < 0.35 * full && gained > 2.0 * short { Ok(told) } else { Err(told) }
}

/// Streams `count` raw pairs; the counters at the end, after they were found to add up.
fn stream(bench: &mut Bench, count: &str) -> Result<Value, String> {
    Ok(stream_lines(bench, count)?.1)
}

/// Streams `count` raw pairs; what was told of each, and the counters at the end, after they were found
/// to add up.
///
/// # Errors
/// When the stream failed or frames are unaccounted for.
pub fn stream_lines(bench: &mut Bench, count: &str) -> Result<(Vec<Value>, Value), String> {
    let source = bench.source();
    let arguments =
        ["stream", "--pairs", "--json", "--timeout", TIMEOUT_S, "--source", &source, "-n", count];
    let text = bench.stspp_ok(60, &arguments)?;
    let mut lines: Vec<Value> =
        text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let last = lines.pop().filter(|last| last.get("stats").is_some());
    let stats = last.ok_or_else(|| format!("no counters: {text}"))?["stats"].clone();
    add_up(&stats)?;
    Ok((lines, stats))
}

/// A counter by its place.
pub fn number(stats: &Value, path: &str) -> u64 {
    stats.pointer(path).and_then(Value::as_u64).unwrap_or(0)
}

/// Every frame is in a pair, rejected by a cause, or dropped.
///
/// # Errors
/// The counters.
pub fn add_up(stats: &Value) -> Result<(), String> {
    let rejected: u64 = stats["rejected"]
        .as_object()
        .map_or(0, |causes| causes.values().filter_map(Value::as_u64).sum());
    let given = number(stats, "/frames_left") + number(stats, "/frames_right");
    let found = 2 * number(stats, "/pairs") + rejected + number(stats, "/dropped_capture");
    if given == found {
        Ok(())
    } else {
        Err(format!("{given} frames, {found} accounted for: {stats}"))
    }
}

fn pairs(bench: &mut Bench) -> Result<String, String> {
    let stats = stream(bench, "10")?;
    let [pairs, triggers] = ["/pairs", "/triggers"].map(|p| number(&stats, p));
    bench.dark()?;
    Ok(format!("{pairs} pairs of {triggers} triggers, all frames accounted for"))
}

fn busy(bench: &mut Bench) -> Result<String, String> {
    // One process holds the device while another asks for it.
    let source = bench.source();
    let arguments = [
        "run",
        "30",
        "/bin/stspp",
        "stream",
        "--pairs",
        "--timeout",
        TIMEOUT_S,
        "--source",
        &source,
        "-n",
        "20",
    ];
    bench.machine.send(&arguments)?;
    bench.wait_lit()?;
    let reply = bench.side(&["run", "20", "/bin/stspp", "info", "--source", "usb:"])?;
    let first = bench.machine.receive()?;
    if reply.code != 5 || !reply.text().contains("in use by another program") {
        return Err(format!("code {}: {}", reply.code, reply.text()));
    }
    if first.code != 0 {
        return Err(format!("the owner was disturbed: {}", first.text()));
    }
    Ok("named, exit code 5; the owner was not disturbed".into())
}

fn frame_fault(bench: &mut Bench, camera: &str, fault: &str) -> Result<String, String> {
    bench.start_stream("40", &[])?;
    bench.wait_lit()?;
    std::thread::sleep(Duration::from_millis(1500));
    bench.server.command(&format!("fault {camera} {fault}"))?;
    let stats = bench.finish_stream()?;
    add_up(&stats)?;
    let counted: Vec<String> = [
        ("lost partner", "/rejected/partner_missing"),
        ("duplicate", "/rejected/duplicate"),
        ("late", "/rejected/late"),
        ("mislabelled", "/rejected/mislabelled"),
        ("without trigger", "/rejected/no_trigger"),
        ("damaged left", "/damaged_left"),
        ("damaged right", "/damaged_right"),
        ("missing left", "/missing_left"),
        ("missing right", "/missing_right"),
    ]
    .into_iter()
    .filter(|(_, path)| number(&stats, path) > 0)
    .map(|(name, path)| format!("{} {name}", number(&stats, path)))
    .collect();
    Ok(format!("40 pairs went on; counted: {}", counted.join(", ")))
}

/// One transfer of trigger events is lost or damaged: the events in it are missed and counted, and their
/// frames labelled as nothing else.
fn event_fault(bench: &mut Bench, fault: &str) -> Result<String, String> {
    bench.start_stream("40", &[])?;
    bench.wait_lit()?;
    std::thread::sleep(Duration::from_millis(1500));
    bench.server.command(&format!("fault events {fault}"))?;
    let stats = bench.finish_stream()?;
    add_up(&stats)?;
    let [lost, rejected] = ["/events_lost", "/rejected/no_trigger"].map(|p| number(&stats, p));
    if lost == 0 {
        return Err(format!("no event was missed: {stats}"));
    }
    Ok(format!("40 pairs went on; {lost} events lost, {rejected} frames without trigger"))
}

fn halt(bench: &mut Bench) -> Result<String, String> {
    bench.start_stream("40", &[])?;
    bench.wait_lit()?;
    std::thread::sleep(Duration::from_millis(700));
    bench.server.command("halt replies")?;
    std::thread::sleep(Duration::from_millis(700));
    bench.server.command("halt events")?;
    let stats = bench.finish_stream()?;
    add_up(&stats)?;
    let repeated = number(&stats, "/link/repeated");
    Ok(format!("both IN endpoints halted and cleared, {repeated} requests repeated"))
}

/// Unplugs `device` during a stream that waits for it, plugs it in again, and expects the stream to
/// go on.
fn unplug(bench: &mut Bench, device: &str) -> Result<String, String> {
    bench.start_stream("50", &["--reconnect", "30"])?;
    bench.wait_lit()?;
    std::thread::sleep(Duration::from_millis(1500));
    bench.server.command(&format!("unplug {device}"))?;
    let dark_ms = bench.wait_dark()?.as_millis();
    bench.server.command(&format!("plug {device}"))?;
    bench.plug_in(device)?;
    bench.finish_stream()?;
    bench.dark()?;
    Ok(format!("dark within {dark_ms} ms, the same process streamed on"))
}

fn camera_unplugged(bench: &mut Bench) -> Result<String, String> {
    unplug(bench, "right")
}

fn control_unplugged(bench: &mut Bench) -> Result<String, String> {
    unplug(bench, "control")
}

/// Does something to the device during a stream and expects it to end with an error that says `word`.
fn ends_with(bench: &mut Bench, command: &str, word: &str) -> Result<String, String> {
    bench.start_stream("400", &[])?;
    bench.wait_lit()?;
    std::thread::sleep(Duration::from_millis(1000));
    bench.server.command(command)?;
    let reply = bench.machine.receive()?;
    let text = reply.text();
    let error = text.lines().rfind(|line| line.contains("error:")).unwrap_or_default().to_owned();
    bench.dark()?;
    if reply.code == 0 || !error.contains(word) {
        return Err(format!("code {}: {text}", reply.code));
    }
    Ok(error.trim_start_matches("error: ").chars().take(90).collect())
}

/// The device is plugged in again by its kernel, its faults are cleared, and it streams.
fn works_again(bench: &mut Bench, told: String) -> Result<String, String> {
    bench.plug_in_again().map_err(|e| format!("{e}, after {told:?}"))?;
    let source = bench.source();
    bench.stspp_ok(30, &["doctor", "--clear-faults", "--quiet", "--source", &source])?;
    // A device that restarted has its default timing.
    set_timing(bench)?;
    stream(bench, "12")?;
    Ok(told)
}

/// What a host says whose device left the bus, as one does that restarts: by its reset pin, or by the
/// watchdog after its firmware hung.
const GONE: &str = "the sensor is gone";

fn reset(bench: &mut Bench) -> Result<String, String> {
    let told = ends_with(bench, "reset", GONE)?;
    works_again(bench, told)
}

fn hang(bench: &mut Bench) -> Result<String, String> {
    let told = ends_with(bench, "hang", GONE)?;
    works_again(bench, told)
}

fn interlock(bench: &mut Bench) -> Result<String, String> {
    let told = ends_with(bench, "interlock open", "interlock opened")?;
    bench.server.command("interlock closed")?;
    works_again(bench, told)
}

fn clock_step(bench: &mut Bench) -> Result<String, String> {
    bench.start_stream("40", &[])?;
    bench.wait_lit()?;
    std::thread::sleep(Duration::from_millis(1000));
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    let stepped = now.map_or(0, |d| d.as_secs()) + 7200;
    bench.side(&["clock", &stepped.to_string()])?;
    let stats = bench.finish_stream()?;
    add_up(&stats)?;
    Ok("two hours forward; 40 pairs went on".into())
}
