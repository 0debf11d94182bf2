//! An output folder whose files appear together or not at all.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Stages that are being filled: what an interrupted program has to remove.
static UNFINISHED: Mutex<Vec<Unfinished>> = Mutex::new(Vec::new());

#[derive(Debug)]
struct Unfinished {
    stage: PathBuf,
    made: Vec<PathBuf>,
}

impl Unfinished {
    fn remove(&self) {
        // Failures here come after one that is reported already.
        let _ = fs::remove_dir_all(&self.stage);
        for path in &self.made {
            let _ = fs::remove_dir(path);
        }
    }
}

fn unfinished() -> MutexGuard<'static, Vec<Unfinished>> {
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes what all unfinished outputs of this process have written so far: for a program that is about
/// to end without unwinding. An output that is just being moved into place is waited for.
pub fn discard_unfinished() {
    for output in unfinished().drain(..) {
        output.remove();
    }
}

/// Why an output could not be written. Nothing of it is left behind.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OutputError {
    /// A file of this name is there and may not be replaced.
    #[error("{}: exists already", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The file system says no.
    #[error("{}: cannot be written: {source}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
}

impl OutputError {
    /// The file and the system's reason.
    pub fn into_parts(self) -> (PathBuf, io::Error) {
        match self {
            Self::Exists { path } => (path, io::ErrorKind::AlreadyExists.into()),
            Self::Write { path, source } => (path, source),
        }
    }
}

/// Collects files in a hidden folder and moves them into place at the end; dropped without
/// [`Self::commit`], it leaves no trace.
#[derive(Debug)]
pub struct OutputFolder {
    target: PathBuf,
    stage: PathBuf,
    /// Folders above the target that were made for it, innermost first.
    made: Vec<PathBuf>,
    target_existed: bool,
    replace: bool,
    files: Vec<PathBuf>,
    committed: bool,
}

impl OutputFolder {
    /// Begins writing into `target`, which is made if it is missing. Files that are there already are
    /// replaced if `replace` is set and are an error otherwise; files of other names are kept.
    ///
    /// # Errors
    /// When no file can be made there: found out before the work that fills them.
    pub fn create(target: &Path, replace: bool) -> Result<Self, OutputError> {
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |source| OutputError::Write { path, source }
        };
        let target_existed = match fs::metadata(target) {
            Ok(metadata) if metadata.is_dir() => true,
            Ok(_) => return Err(failed(target)(io::ErrorKind::NotADirectory.into())),
            Err(e) if e.kind() == io::ErrorKind::NotFound => false,
            Err(e) => return Err(failed(target)(e)),
        };
        let name = format!(".stspp-{}.part", std::process::id());
        let mut folder = Self {
            stage: target.join(&name),
            target: target.to_owned(),
            made: Vec::new(),
            target_existed,
            replace,
            files: Vec::new(),
            committed: false,
        };
        if !target_existed {
            folder.make_parents()?;
            let leaf = target.file_name().unwrap_or_default().to_string_lossy().into_owned();
            folder.stage = target.with_file_name(format!(".{leaf}{name}"));
        }
        let mut unfinished = unfinished();
        fs::create_dir(&folder.stage).map_err(failed(&folder.stage))?;
        unfinished.push(Unfinished { stage: folder.stage.clone(), made: folder.made.clone() });
        drop(unfinished);
        Ok(folder)
    }

    fn make_parents(&mut self) -> Result<(), OutputError> {
        let parents = self.target.ancestors().skip(1).filter(|p| !p.as_os_str().is_empty());
        let missing: Vec<PathBuf> =
            parents.take_while(|p| !p.exists()).map(Path::to_owned).collect();
        for path in missing.into_iter().rev() {
            fs::create_dir(&path)
                .map_err(|source| OutputError::Write { path: path.clone(), source })?;
            self.made.insert(0, path);
        }
        Ok(())
    }

    /// Adds the file `name` (with `/` for folders in it), written by `fill`; again, and it is replaced.
    ///
    /// # Errors
    /// From `fill` or the file system; [`OutputError::Exists`].
    pub fn file(
        &mut self,
        name: &str,
        fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<(), OutputError> {
        let shown = self.target.join(name);
        if self.target_existed && !self.replace && shown.exists() {
            return Err(OutputError::Exists { path: shown });
        }
        let staged = self.stage.join(name);
        let again = staged.exists();
        let written = || -> io::Result<()> {
            if let Some(parent) = staged.parent() {
                fs::create_dir_all(parent)?;
            }
            let mut out = BufWriter::with_capacity(1 << 18, File::create(&staged)?);
            fill(&mut out)?;
            // A full disk may show only when the data leave the buffers.
            out.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()
        };
        written().map_err(|source| OutputError::Write { path: shown, source })?;
        if !again {
            self.files.push(PathBuf::from(name));
        }
        Ok(())
    }

    /// Moves all files into place.
    ///
    /// # Errors
    /// When the file system refuses.
    pub fn commit(mut self) -> Result<(), OutputError> {
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |source| OutputError::Write { path, source }
        };
        let mut unfinished = unfinished();
        if self.target_existed {
            for name in &self.files {
                let to = self.target.join(name);
                if let Some(parent) = to.parent() {
                    fs::create_dir_all(parent).map_err(failed(parent))?;
                }
                fs::rename(self.stage.join(name), &to).map_err(failed(&to))?;
            }
            let _ = fs::remove_dir_all(&self.stage);
        } else {
            fs::rename(&self.stage, &self.target).map_err(failed(&self.target))?;
        }
        unfinished.retain(|output| output.stage != self.stage);
        self.committed = true;
        Ok(())
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        if self.committed {
            return;
        }
        unfinished().retain(|output| output.stage != self.stage);
        Unfinished { stage: self.stage.clone(), made: self.made.clone() }.remove();
    }
}
