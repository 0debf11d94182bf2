//! The report: one HTML page that holds everything, and a Markdown table.

use std::fmt::Write;

use super::chart::escaped;
use super::{Row, Section};

const STYLE: &str = "\
body{font:16px/1.5 system-ui,sans-serif;max-width:1080px;margin:2rem auto;padding:0 1rem;color:#1c1c1c;\
background:#fff}h1{font-size:1.7rem}h2{font-size:1.25rem;margin-top:2.6rem;border-top:1px solid #ccc;\
padding-top:1.2rem}table{border-collapse:collapse;width:100%;font-size:.92rem}th,td{text-align:left;\
padding:.3rem .6rem;border-bottom:1px solid #ddd;vertical-align:top}td.n{text-align:right;\
font-variant-numeric:tabular-nums;white-space:nowrap}td.good{color:#14713a;font-weight:600}\
td.bad{color:#a3262f;font-weight:600}td.note{color:#555;font-size:.86rem}\
.chart{width:100%;max-width:760px;display:block;margin:1rem 0}.chart .frame{fill:none;stroke:#888}\
.chart .grid{stroke:#e2e2e2}.chart text{font:12px system-ui,sans-serif;fill:#333}\
.chart .title{font-weight:600;font-size:14px}.chart .end{text-anchor:end}.chart .middle{text-anchor:middle}\
.pictures{display:grid;grid-template-columns:repeat(auto-fill,minmax(300px,1fr));gap:1rem;margin:1rem 0}\
figure{margin:0}figure img{width:100%;height:300px;object-fit:contain;background:#0c0c0e}figcaption{font-size:.84rem;color:#444}";

/// What stands above everything, in both reports.
const ABOUT: &str = "The evaluation of the ST-SPP paper (Figures 2 to 8), repeated on the simulated \
sensor: two cameras of 1280 x 1024 pixels and 8 bits, 10 000 electrons full well, 3 electrons of read \
noise, 0.6 px of blur, ten projectors. The paper's figures come from its real hardware and objects, but for \
Figure 2, which it renders. Ours come from models of such hardware and objects, with a calibration without \
error and surfaces known exactly: they show what optics, noise and matcher leave, and not what a real \
sensor's calibration, temperature and materials add.";

/// The HTML page; `made_by` is a line on version, method and time.
pub fn html(sections: &[Section], made_by: &str) -> String {
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <title>stspp: the paper's experiments on the simulated sensor</title><style>{STYLE}</style></head>\
         <body><h1>The paper's experiments on the simulated sensor</h1><p>{}</p><p>{}</p>{}",
        escaped(ABOUT),
        escaped(made_by),
        summary(sections),
    );
    for section in sections {
        let _ = write!(
            page,
            "<h2 id=\"{0}\">Figure {1}: {2}</h2><p>{3}</p>{4}",
            section.figure.name(),
            &section.figure.name()[3..],
            escaped(section.title),
            with_code(&section.about),
            table(&section.rows)
        );
        for chart in &section.charts {
            page += &chart.to_svg();
        }
        page += "<div class=\"pictures\">";
        for picture in &section.pictures {
            let caption = escaped(&picture.caption);
            let _ = write!(
                page,
                "<figure><img alt=\"{caption}\" src=\"data:image/png;base64,{}\"><figcaption>{caption}\
                 </figcaption></figure>",
                base64(&picture.png)
            );
        }
        page += "</div>";
    }
    page + "</body></html>\n"
}

/// Text for HTML, with what stands between backticks as code.
fn with_code(text: &str) -> String {
    let parts: Vec<String> = text.split('`').map(escaped).collect();
    let coded = parts.iter().enumerate().map(|(k, part)| match k % 2 {
        1 => format!("<code>{part}</code>"),
        _ => part.clone(),
    });
    coded.collect()
}

/// How many comparisons there are, and which are not won.
fn summary(sections: &[Section]) -> String {
    let rows = || sections.iter().flat_map(|s| s.rows.iter().map(move |r| (s, r)));
    let compared = rows().filter(|(_, r)| r.is_better().is_some()).count();
    let worse: Vec<String> = rows()
        .filter(|(_, r)| r.is_better() == Some(false))
        .map(|(s, r)| {
            let id = s.figure.name();
            format!("<a href=\"#{id}\">Figure {}</a>: {}", &id[3..], escaped(&r.quantity))
        })
        .collect();
    let better = compared - worse.len();
    let mut text = format!("<p><b>{better} of {compared} printed figures are bettered.</b>");
    if !worse.is_empty() {
        let _ = write!(text, " Not so, with the reason in the table: {}.", worse.join("; "));
    }
    text + "</p>"
}

fn number(value: f64, digits: usize) -> String {
    format!("{value:.digits$}")
}

fn verdict(row: &Row) -> (&'static str, &'static str) {
    match row.is_better() {
        Some(true) => ("better", "good"),
        Some(false) => ("worse", "bad"),
        None => ("", ""),
    }
}

fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "<table><thead><tr><th>Quantity</th><th>Paper</th><th>Ours</th><th></th><th>Note</th></tr></thead>\
         <tbody>",
    );
    for row in rows {
        let (word, class) = verdict(row);
        let paper = row.paper.map_or("–".to_owned(), |v| number(v, row.digits));
        let _ = write!(
            text,
            "<tr><td>{}</td><td class=\"n\">{paper}</td><td class=\"n\">{}</td><td class=\"{class}\">{word}\
             </td><td class=\"note\">{}</td></tr>",
            escaped(&row.quantity),
            number(row.ours, row.digits),
            escaped(&row.note)
        );
    }
    text + "</tbody></table>"
}

/// The Markdown table, for the book.
pub fn markdown(sections: &[Section], made_by: &str) -> String {
    let mut text = format!(
        "# The paper's experiments on the simulated sensor\n\n{ABOUT}\n\n{made_by}\n\nMade by `stspp \
         experiment all --out DIR`, which also writes `report.html` with pictures and charts.\n"
    );
    for section in sections {
        let _ = write!(
            text,
            "\n## Figure {}: {}\n\n{}\n\n| Quantity | Paper | Ours | | Note |\n|---|---|---|---|---|\n",
            &section.figure.name()[3..],
            section.title,
            section.about
        );
        for row in &section.rows {
            let paper = row.paper.map_or("–".to_owned(), |v| number(v, row.digits));
            let ours = number(row.ours, row.digits);
            let (word, _) = verdict(row);
            let [quantity, note] = [&row.quantity, &row.note].map(|t| t.replace('|', "\\|"));
            let _ = writeln!(text, "| {quantity} | {paper} | {ours} | {word} | {note} |");
        }
    }
    text
}

/// RFC 4648 base64 with padding.
fn base64(bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let mut three = [0; 3];
        three[..chunk.len()].copy_from_slice(chunk);
        let bits = u32::from(three[0]) << 16 | u32::from(three[1]) << 8 | u32::from(three[2]);
        for k in 0..4 {
            let digit = ALPHABET[(bits >> (18 - 6 * k) & 63) as usize];
            text.push(if k <= chunk.len() { char::from(digit) } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::{Figure, Good, Picture};
    use super::*;

    #[test]
    fn base64_agrees_with_the_standards_examples() {
        let examples =
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")];
        for (plain, coded) in examples {
            assert_eq!(base64(plain.as_bytes()), coded);
        }
    }

    #[test]
    fn the_report_tells_better_from_worse_and_is_whole_in_itself() {
        let mut section = Section::new(Figure::Fig5, "Planes", "a < b by `--c`");
        section.rows.push(Row::error_mm("RMS", Some(0.2), 0.1));
        section.rows.push(Row::error_mm("other RMS", Some(0.2), 0.3).note("because | of this"));
        section.rows.push(Row { good: Good::Large, ..Row::error_mm("share", Some(1.0), 2.0) });
        section.pictures.push(Picture { caption: "a picture".into(), png: vec![1, 2, 3] });
        let page = html(&[section.clone()], "version 0");
        assert!(page.contains("2 of 3 printed figures are bettered"));
        assert!(page.contains("href=\"#fig5\">Figure 5</a>: other RMS"));
        assert!(
            page.contains("a &lt; b by <code>--c</code>")
                && page.contains("data:image/png;base64,AQID")
        );
        assert!(!page.contains("http"), "nothing is fetched");
        let table = markdown(&[section], "version 0");
        assert!(
            table.contains("| other RMS, mm | 0.2000 | 0.3000 | worse | because \\| of this |")
        );
    }
}
