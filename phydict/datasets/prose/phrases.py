"""The words of chest reports: names of findings by kind, where they lie, how they are stated, denied and passed over.

Slots: {g} a word for the size and a space, or nothing; {side}, {lobe}, {abbr} (as in RUL), {s} "right" or "left" of an
organ that is no finding's, {n} a number of mm. Names begin with their article, where they take one.
"""

from __future__ import annotations

SINGLE = {
    "nodule": ["a {g}nodule", "a {g}pulmonary nodule", "a {g}solid nodule", "a {g}nodular lesion",
               "a {g}nodular density", "a {g}nodular opacity", "a {g}well-defined nodule", "a {g}noncalcified nodule",
               "a {g}solitary pulmonary nodule", "a {g}round nodule", "a {g}parenchymal nodule",
               "a {g}nonspecific nodule", "a {g}smooth nodule"],
    "mass": ["a {g}mass", "a {g}mass lesion", "a {g}soft tissue mass", "a {g}pulmonary mass", "a {g}spiculated mass",
             "a {g}lobulated mass", "a {g}space-occupying mass", "a {g}mass of soft tissue density", "a {g}tumour mass",
             "a {g}tumoral mass", "a {g}heterogeneous mass", "a {g}irregular mass"],
    "effusion": ["a {g}pleural effusion", "{g}pleural effusion", "{g}pleural fluid", "a {g}amount of pleural fluid",
                 "a {g}layering pleural effusion", "a {g}free-flowing pleural effusion", "{g}fluid in the pleura",
                 "a {g}collection of pleural fluid", "a {g}effusion in the pleural space", "{g}hydrothorax"],
    "consolidation": ["{g}consolidation", "{g}airspace consolidation", "a {g}area of consolidation",
                      "{g}consolidation with air bronchograms", "a {g}consolidated area", "{g}consolidative change",
                      "a {g}consolidative opacity", "{g}alveolar consolidation", "{g}parenchymal consolidation",
                      "{g}pneumonic consolidation", "{g}dense consolidation", "{g}lung consolidation"],
    "opacity": ["a {g}ground-glass opacity", "{g}ground-glass opacification", "a {g}area of ground-glass attenuation",
                "{g}ground glass density", "{g}GGO", "a {g}hazy opacity", "{g}hazy ground-glass change",
                "a {g}ground-glass density increase", "a {g}infiltrate of ground-glass density", "{g}patchy opacity",
                "a {g}area of ground glass appearance", "{g}ground-glass infiltration"],
    "atelectasis": ["{g}atelectasis", "{g}subsegmental atelectasis", "{g}linear atelectasis", "{g}atelectatic change",
                    "{g}dependent atelectasis", "{g}plate-like atelectasis", "{g}discoid atelectasis",
                    "{g}passive atelectasis", "{g}compressive atelectasis", "{g}atelectatic lung",
                    "a {g}band of atelectasis", "{g}basal atelectasis", "{g}collapse with volume loss"],
    "emphysema": ["{g}emphysema", "{g}pulmonary emphysema", "{g}centrilobular emphysema", "{g}emphysematous change",
                  "{g}centriacinar emphysema", "{g}paraseptal emphysema", "{g}bullous emphysema",
                  "{g}panlobular emphysema", "{g}upper-lobe predominant emphysema"],
    "cardiomegaly": ["{g}cardiomegaly", "{g}enlargement of the heart", "{g}cardiac enlargement", "a {g}enlarged heart",
                     "a {g}enlarged cardiac silhouette", "a {g}increase in heart size", "{g}dilated heart chambers"],
    "pericardial effusion": ["a {g}pericardial effusion", "{g}pericardial effusion", "{g}pericardial fluid",
                             "{g}fluid around the heart", "a {g}effusion in the pericardial space",
                             "{g}fluid in the pericardial sac", "a {g}amount of pericardial fluid"],
    "pneumothorax": ["a {g}pneumothorax", "{g}pneumothorax", "{g}free pleural air", "{g}free air in the pleural space",
                     "{g}air in the pleural cavity"],
}
"""One finding, in the singular."""

SEVERAL = {
    "nodule": ["{g}nodules", "{g}pulmonary nodules", "multiple {g}nodules", "a few {g}nodules", "several nodules",
               "millimetric nodules", "scattered {g}nodules", "nodular lesions", "nodular densities", "tiny nodules",
               "small solid nodules", "nonspecific nodules", "nodules of a few millimetres", "micronodules",
               "calcified and noncalcified nodules", "subcentimetre nodules", "parenchymal nodules"],
    "mass": ["{g}masses", "multiple masses", "mass lesions", "soft tissue masses", "pulmonary masses"],
    "effusion": ["{g}pleural effusions", "{g}pleural effusion", "{g}pleural fluid", "{g}effusions in the pleura"],
    "consolidation": ["{g}consolidations", "{g}consolidation", "{g}areas of consolidation", "consolidated areas",
                      "patchy {g}consolidations", "multifocal consolidation", "{g}consolidative opacities",
                      "consolidation areas", "consolidative densities", "pneumonic consolidations"],
    "opacity": ["{g}ground-glass opacities", "patchy ground-glass opacities", "ground glass densities", "GGOs",
                "{g}ground-glass areas", "{g}areas of ground-glass attenuation", "hazy opacities",
                "ground-glass density increases", "patchy infiltrates", "{g}infiltrates of ground-glass density",
                "peripheral ground-glass opacities", "nodular ground-glass opacities", "infiltrative densities",
                "patchy opacities", "ground glass appearances", "crazy paving and ground-glass opacities"],
    "atelectasis": ["{g}atelectasis", "{g}atelectatic changes", "linear atelectasis", "bands of atelectasis",
                    "{g}dependent atelectasis", "atelectatic densities", "subsegmental atelectases",
                    "plate-like atelectases", "linear atelectatic bands", "{g}atelectatic areas"],
    "emphysema": ["{g}emphysematous changes", "emphysematous areas", "{g}centrilobular emphysematous changes",
                  "bullae and {g}emphysematous changes", "{g}emphysematous lungs", "emphysematous bullae"],
    "cardiomegaly": ["{g}dilated cardiac chambers", "enlarged heart chambers"],
    "pericardial effusion": ["{g}pericardial effusions"],
    "pneumothorax": ["{g}pneumothoraces", "{g}pneumothorax"],
}
"""Several findings of a kind, or one in the plural."""

GRADE_WORDS = {
    "small": ["small", "minimal", "slight", "trace"],
    "moderate": ["moderate", "moderate-sized", "medium"],
    "large": ["large", "massive", "sizeable"],
    "focal": ["focal", "small", "localised", "limited"],
    "extensive": ["extensive", "widespread", "large"],
    "complete": ["complete", "lobar", "total"],
    "mild": ["mild", "slight", "minimal"],
    "severe": ["severe", "advanced", "marked"],
    "marked": ["marked", "severe"],
}
"""What a report may write for a grade of `findings.GRADES`."""

LOBE_PLACES = ["in the {side} {lobe} lobe", "within the {side} {lobe} lobe", "in the {lobe} lobe of the {side} lung",
               "involving the {side} {lobe} lobe", "in the {abbr}", "at the {side} {lobe} lobe",
               "in the {side} lung {lobe} lobe", "located in the {side} {lobe} lobe",
               "in the {lobe} lobe on the {side}"]
SEGMENT_PLACES = ["in the {segment} segment of the {side} {lobe} lobe", "in the {abbr}, {segment} segment",
                  "in the {side} {lobe} lobe {segment} segment", "in the {side} lung {lobe} lobe {segment} segment",
                  "in the {lobe} lobe {segment} segment of the {side} lung"]
SEGMENTS = {
    "upper": ["anterior", "posterior", "apical", "apicoposterior"],
    "middle": ["medial", "lateral"],
    "lower": ["superior", "posterobasal", "laterobasal", "anterobasal", "mediobasal", "posterior basal"],
}
PAIR_PLACES = ["in both {lobe} lobes", "in the {lobe} lobes bilaterally", "in the bilateral {lobe} lobes",
               "in the {lobe} lobes of both lungs", "in both lungs, in the {lobe} lobes"]
LUNG_PLACES = ["in the {side} lung", "throughout the {side} lung", "in all lobes of the {side} lung",
               "in the {side} hemithorax", "in the parenchyma of the {side} lung"]
BOTH_PLACES = ["in both lungs", "bilaterally", "in all lobes of both lungs", "throughout both lungs",
               "scattered in both lungs", "in the lungs bilaterally", "in the parenchyma of both lungs"]
PLEURA_PLACES = ["on the {side}", "on the {side} side", "in the {side} pleural space", "in the {side} hemithorax",
                 "in the {side} pleural cavity"]
PLEURAE_PLACES = ["on both sides", "bilaterally", "in both hemithoraces", "in both pleural spaces", "in both pleurae"]
EMPHYSEMA_PLACES = ["in both lungs", "bilaterally", "in both lungs, most marked in the upper lobes",
                    "predominantly in the upper lobes of both lungs", "throughout both lungs", ""]

STATEMENTS = ["There {is} {name} {place}.", "{name} {place}.", "{name} {is} seen {place}.",
              "{name} {is} noted {place}.", "{name} {was} observed {place}.", "{name} {was} detected {place}.",
              "{name} {is} present {place}.", "{name} {is} identified {place}.", "Note {is1} made of {name} {place}.",
              "{place}, there {is} {name}.", "{place}, {name} {is} seen.", "The scan shows {name} {place}.",
              "Axial images show {name} {place}.", "CT demonstrates {name} {place} (arrow).",
              "Findings include {name} {place}.", "{name} {is} visible {place}.", "{name} {was} found {place}.",
              "We see {name} {place}.", "{name} {is} evident {place}.", "{name} {is} striking {place}.",
              "Evidence of {name} {place}."]
SHORT = ["{name} {place}.", "{name} {place}.", "{place}: {name}."]
TAILS = ["", "", "", "", ", unchanged", ", new since the previous examination", ", stable in comparison with before",
         ", smaller than before", ", increased in size since the prior study", " as described above"]
LINKS = [", and ", " and ", ", with ", " with adjacent ", " accompanied by ", "; also ", " as well as "]
YET = [", but ", "; however, ", ", although "]
WITHOUT = [", without ", " without ", ", no ", " but no ", ", no evidence of ", " and no "]
HEART_STATEMENTS = ["The heart is {g}enlarged{ratio}.", "Heart size is {g}increased{ratio}.",
                    "Cardiac size is increased{ratio}.", "The cardiac silhouette is enlarged{ratio}.",
                    "The cardiothoracic ratio is increased{ratio}.", "The heart is larger than normal{ratio}.",
                    "{g}cardiomegaly{ratio}.", "There is {g}cardiomegaly{ratio}.", "Increased heart size{ratio}.",
                    "The heart dimensions are increased{ratio}.", "Cardiothoracic index increased{ratio}."]
"""The {ratio} is a comma and the cardiothoracic ratio, or nothing."""

DENIED_NAMES = {
    "nodule": ["pulmonary nodule", "nodule", "nodular lesion", "suspicious nodule", "lung nodule"],
    "mass": ["mass", "mass lesion", "space-occupying lesion", "suspicious mass", "tumour"],
    "effusion": ["pleural effusion", "pleural fluid", "effusion in the pleural space"],
    "consolidation": ["consolidation", "airspace consolidation", "focal consolidation", "infiltration",
                      "pneumonic consolidation"],
    "opacity": ["ground-glass opacity", "ground glass density", "infiltrate", "GGO", "infiltrative lesion"],
    "atelectasis": ["atelectasis", "atelectatic change", "collapse", "volume loss"],
    "emphysema": ["emphysema", "emphysematous change", "bullae"],
    "cardiomegaly": ["cardiomegaly", "cardiac enlargement", "enlargement of the heart"],
    "pericardial effusion": ["pericardial effusion", "pericardial fluid", "fluid around the heart"],
    "pneumothorax": ["pneumothorax", "free pleural air"],
}
DENIED_ELSEWHERE = ["pathologically enlarged lymph node", "lymphadenopathy", "fracture", "aneurysm", "embolism",
                    "pleural thickening", "pericardial thickening", "filling defect", "lytic lesion",
                    "hilar adenopathy", "destructive bone lesion", "free abdominal fluid", "cavity"]
DENIALS = ["No {list}.", "There is no {list}.", "No evidence of {list}.", "There is no evidence of {list}.",
           "Without evidence of {list}.", "No {list} is seen.", "No {list} was detected.", "No {list} was observed.",
           "No sign of {list}.", "{list} was not detected.", "{list} was not observed.", "{list} is not seen.",
           "Negative for {list}.", "No {list} is identified.", "{list}: none.", "Absence of {list}.",
           "No {list} is present.", "There are no signs of {list}.", "{list} is not present.",
           "Neither {list} is seen.", "No {list} could be distinguished.", "{list} not evident.", "No definite {list}.",
           "No obvious {list}."]
RESOLVED = ["The {name} of the previous examination has resolved.", "The {name} seen before is no longer present.",
            "Previously described {name} is not seen in the current study.", "Complete resolution of the {name}.",
            "The {name} described earlier has disappeared.", "Interval resolution of {name}."]
NORMAL_HEART = ["Heart size is normal.", "The heart is of normal size.", "Normal heart size.",
                "The heart is not enlarged.", "Cardiac size and contour are normal.",
                "Heart contour and size are normal.", "The heart and great vessels are unremarkable.",
                "Heart size within normal limits.",
                "Calibre of the great vessels and dimensions of the heart are within normal limits.",
                "Cardiothoracic ratio is normal.", "The cardiomediastinal silhouette is normal."]
CLEAR_LUNGS = ["The lungs are clear.", "Both lungs are clear.", "Lung parenchyma is unremarkable.",
               "Normal aeration of both lungs.", "Aeration of the lung parenchyma is normal.", "Clear lungs.",
               "The lung parenchyma has a natural appearance.", "Lungs: normal."]
CLEAR_PLEURA = ["The pleural spaces are clear.", "Pleural surfaces are smooth.", "The costophrenic angles are sharp.",
                "Both costophrenic sinuses are open.", "The pleurae are unremarkable."]
NORMAL_CHEST = ["No acute abnormality in the thorax.", "Chest CT within normal limits.", "Normal chest CT.",
                "No acute cardiopulmonary disease.", "Unremarkable examination of the chest.",
                "No significant abnormality.", "Normal study.", "Thoracic CT without pathological findings."]
OPENINGS = ["Lungs: ", "Lung parenchyma: ", "Pleura: ", "Heart: ", "In the lung window; ", "As far as can be seen, ",
            "In addition, ", "Furthermore, ", "On the other hand, ", "Mediastinum: ", "At the level examined, ", "1. "]
SUPPOSITIONS = [", consistent with pneumonia", " (infection?)", ", suspicious for malignancy", ", most likely benign",
                " in favour of metastasis", ", probably inflammatory", " secondary to heart failure",
                " evaluated as infectious", ", nonspecific in appearance", " in the adjacent parenchyma",
                ", more pronounced in the dependent parts", " with a subpleural distribution"]
SIDED = ["{side} ", "{side}-sided ", "{side} "]
SIZES = ["{mm:.0f} mm", "{mm:.0f} mm", "{cm:.1f} cm", "{mm:.0f} x {across:.0f} mm", "{mm:.0f}x{across:.0f} mm"]
LARGEST = [" of up to {size}", ", the largest {size},", " measuring up to {size}"]
MEASURES = [" measuring {size}", " with a diameter of {size}", " of {size}", " ({size})"]
DEPTHS = [" measuring {mm} mm", " of up to {mm} mm", " reaching {mm} mm in thickness"]
RATIO = ", cardiothoracic ratio {ratio:.2f}"
