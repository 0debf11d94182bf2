//! The outputs as files: CSV, and VCD (IEEE 1364-2005 chapter 18) for waveform viewers.

use std::io::{self, Write};

use stspp_hil_sim::device::{Line, PinEdge};

/// Name of a line in the files.
#[must_use]
pub fn line_name(line: Line) -> String {
    match line {
        Line::Projector(index) => format!("projector_{index}"),
        Line::Floodlight => "floodlight".to_string(),
        Line::CameraTrigger(index) => format!("camera_trigger_{index}"),
    }
}

/// Every line of the sensor.
#[must_use]
pub fn all_lines() -> Vec<Line> {
    (0..10)
        .map(Line::Projector)
        .chain([Line::Floodlight, Line::CameraTrigger(0), Line::CameraTrigger(1)])
        .collect()
}

/// Writes edges as `time_ns,line,level`.
///
/// # Errors
/// Those of the writer.
pub fn write_csv(edges: &[PinEdge], out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "time_ns,line,level")?;
    for edge in edges {
        writeln!(out, "{},{},{}", edge.time_ns, line_name(edge.line), u8::from(edge.high))?;
    }
    Ok(())
}

/// Writes edges as a value change dump with a resolution of 1 ns; all lines start low.
///
/// # Errors
/// Those of the writer.
pub fn write_vcd(edges: &[PinEdge], out: &mut impl Write) -> io::Result<()> {
    let lines = all_lines();
    // Identifier codes are printable characters from '!' on.
    let code = |index: usize| char::from(b'!' + index as u8);
    writeln!(out, "$timescale 1 ns $end\n$scope module sensor $end")?;
    for (index, line) in lines.iter().enumerate() {
        writeln!(out, "$var wire 1 {} {} $end", code(index), line_name(*line))?;
    }
    writeln!(out, "$upscope $end\n$enddefinitions $end\n#0\n$dumpvars")?;
    for index in 0..lines.len() {
        writeln!(out, "0{}", code(index))?;
    }
    writeln!(out, "$end")?;
    let mut last_ns = 0;
    for edge in edges {
        if edge.time_ns != last_ns {
            writeln!(out, "#{}", edge.time_ns)?;
            last_ns = edge.time_ns;
        }
        if let Some(index) = lines.iter().position(|line| *line == edge.line) {
            writeln!(out, "{}{}", u8::from(edge.high), code(index))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_at_one_time_share_a_time_stamp() {
        let edges = [
            PinEdge { time_ns: 100, line: Line::Projector(0), high: true },
            PinEdge { time_ns: 100, line: Line::CameraTrigger(1), high: true },
            PinEdge { time_ns: 250, line: Line::Projector(0), high: false },
        ];
        let mut vcd = Vec::new();
        write_vcd(&edges, &mut vcd).unwrap();
        let text = String::from_utf8(vcd).unwrap();
        assert!(text.contains("$var wire 1 ! projector_0 $end"), "{text}");
        assert!(text.ends_with("#100\n1!\n1-\n#250\n0!\n"), "{text}");
        let mut csv = Vec::new();
        write_csv(&edges, &mut csv).unwrap();
        assert_eq!(String::from_utf8(csv).unwrap().lines().nth(3), Some("250,projector_0,0"));
    }
}
